"""Values of JSON, XML and CSV that other programs wrote; ValueError names the fault of one."""

import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.errors import InputError, reason

LARGEST_COORDINATE = 1e15  # world units or pixels: squares and their sums stay within float32
LONGEST_SIDE = 1 << 20  # pixels
CONTROL = re.compile(r"[\x00-\x1f\x7f-\x9f\u2028\u2029]")  # control characters and line ends


@contextmanager
def reading(path: str | Path, what: str, cure: str = "export or copy it again") -> Iterator[None]:
    """Report any failure to read a file as one line: libraries raise many kinds of exceptions for
    damaged files. The message says `what` the file is not, with its article, and the cure."""
    try:
        with np.errstate(over="ignore", invalid="ignore"):  # results are checked
            yield
    except InputError:
        raise
    except FileNotFoundError as error:  # of the file, or of one that it names
        raise InputError(f"{error.filename or path}: no such file; check the path") from None
    except ImportError as error:
        raise InputError(f"{path}: {reason(error)}") from None
    except MemoryError:
        raise InputError(f"{path}: not enough memory to read it; free some, or give a smaller file") from None
    except Exception as error:
        raise InputError(f"{path}: not {what}, damaged or cut short ({reason(error)}); {cure}") from None


def number(value: object, what: str) -> float:
    """A number of JSON, which must be finite and of usable size."""
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise ValueError(f"{what} is not a number")
    if not abs(value) <= LARGEST_COORDINATE:
        raise ValueError(f"{what} is not a usable number")
    return float(value)


def parsed(word: str | None, what: str) -> float:
    """A number of text."""
    try:
        value = float(word or "")
    except ValueError:
        raise ValueError(f"{what} is not a number") from None
    return number(value, what)


def numbers(values: object, count: int, what: str) -> NDArray[np.float64]:
    """float64[count] of a list of JSON or of words of text."""
    if isinstance(values, str):
        values = [parsed(word, what) for word in values.split()]
    if not isinstance(values, (list, tuple)) or len(values) != count:
        raise ValueError(f"{what} is not {count} numbers")
    return np.array([number(value, what) for value in values])


def pixels(value: object, what: str) -> int:
    """A side of a photo, pixels."""
    side = number(value, what)
    if side != int(side) or not 0 < side < LONGEST_SIDE:
        raise ValueError(f"{what} is not a number of pixels")
    return int(side)


def text(value: object, what: str) -> str:
    """A line of text."""
    if not isinstance(value, str) or CONTROL.search(value):
        raise ValueError(f"{what} is not valid text")
    return value


def table(value: object, what: str) -> dict[str, Any]:
    """An object of JSON."""
    if not isinstance(value, dict):
        raise ValueError(f"{what} is not an object")
    return value


def tables(values: object, what: str) -> list[dict[str, Any]]:
    """A list of objects of JSON."""
    if not isinstance(values, list):
        raise ValueError(f"{what} is not a list of objects")
    return [table(value, f"an element of {what}") for value in values]
