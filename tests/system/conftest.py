"""What the system tests share: the sample city, one device in its item form, and a run."""

import os

import pytest

from clsplat.device import choose_device
from clsplat.io.scenes import read_scene
from tests.tiny_training import CITY, LEVELLED, trained


@pytest.fixture(scope="session")
def city():
    return read_scene(CITY)


@pytest.fixture(scope="session")
def item_device():
    """Where the kernel form does not matter: the same mathematics, and quick on a CPU."""
    wanted = os.environ.get("CLSPLAT_TEST_DEVICES", "all")
    return choose_device("auto" if wanted == "all" else wanted, form="item")


@pytest.fixture(scope="session")
def levelled(item_device, city, tmp_path_factory):
    """A run of the whole method that nothing stopped; not to be changed."""
    return trained(tmp_path_factory.mktemp("levelled") / "run", city, item_device, **LEVELLED)
