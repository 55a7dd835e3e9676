"""What the tests of formats write and read again."""

import pytest

from tests.data import layouts


@pytest.fixture(scope="module")
def city(city):
    """The sample city with every fourth of its views."""
    return layouts.every_fourth(city)
