"""What the system tests share: the sample city, and one device in its item form."""

import os

import pytest

from clsplat.device import choose_device
from clsplat.io.scenes import read_scene
from tests.tiny_training import CITY


@pytest.fixture(scope="session")
def city():
    return read_scene(CITY)


@pytest.fixture(scope="session")
def item_device():
    """Where the kernel form does not matter: the same mathematics, and quick on a CPU."""
    wanted = os.environ.get("CLSPLAT_TEST_DEVICES", "all")
    return choose_device("auto" if wanted == "all" else wanted, form="item")
