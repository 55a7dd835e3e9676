"""What the system tests share: a run of the whole method."""

import pytest

from tests.data.tiny_training import LEVELLED, trained


@pytest.fixture(scope="session")
def levelled(item_device, city, tmp_path_factory):
    """A run of the whole method that nothing stopped; not to be changed."""
    return trained(tmp_path_factory.mktemp("levelled") / "run", city, item_device, **LEVELLED)
