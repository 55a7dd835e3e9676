"""What cannot be used is refused in one line."""

import pytest

from clsplat.errors import InputError


def refused(call, *words):
    """The one-line message that refuses a call, which contains all of the words."""
    with pytest.raises(InputError) as caught:
        call()
    line = str(caught.value)
    assert "\n" not in line
    for word in words:
        assert word in line, line
    return line
