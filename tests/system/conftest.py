"""What the system tests share: the sample city, one device in its item form, and a run."""


import pytest

from clsplat.io.scenes.read import read_scene
from tests.data.tiny_training import CITY, LEVELLED, trained


@pytest.fixture(scope="session")
def city():
    return read_scene(CITY)


@pytest.fixture(scope="session")
def levelled(item_device, city, tmp_path_factory):
    """A run of the whole method that nothing stopped; not to be changed."""
    return trained(tmp_path_factory.mktemp("levelled") / "run", city, item_device, **LEVELLED)
