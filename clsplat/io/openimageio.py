"""Imports OpenImageIO when the first image is read or written, as many commands need none."""

from typing import Any

from clsplat.interrupt import signals_held


def openimageio() -> Any:
    """The module OpenImageIO; Ctrl-C waits for its import, which it would abort."""
    with signals_held():
        import OpenImageIO
    return OpenImageIO
