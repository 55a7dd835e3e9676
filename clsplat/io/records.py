"""JSON records, which a kill, a disk or a user may change: what is read has finite numbers."""

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from clsplat.errors import InputError, reason
from clsplat.io.atomic import replacing
from clsplat.io.regular import read_regular

LARGEST_NUMBER = 1e100  # sums of squares stay finite
# of the files of runs and cities, see docs/guide/files.md: it grows if an earlier clsplat would
# misread what this one writes
FORMAT = 1
FORMAT_KEY = "format"


def object_of(data: bytes) -> dict[str, Any]:
    """Parse a JSON object; ValueError unless its numbers are finite and its text is Unicode."""
    try:
        table = json.loads(data, parse_constant=_finite, parse_float=_finite, parse_int=_integer)
        # only an escape can stand for half a surrogate pair, which no file can hold
        if b"\\ud" in data.lower():
            json.dumps(table, ensure_ascii=False).encode()
    except RecursionError:
        raise ValueError("nested too deeply") from None
    if not isinstance(table, dict):
        raise ValueError("not a JSON object")
    return table


def read_object(path: Path, kinds: Mapping[str, type], cure: str) -> dict[str, Any]:
    """Read a JSON file; InputError, with this cure, if it is missing or damaged, or a key is not of
    its type in `kinds`."""
    try:
        record = object_of(read_regular(path))
        check_format(path, record)  # first, as other keys may have changed
        for key, kind in kinds.items():
            if type(record.get(key)) is not kind:
                raise ValueError(f"{key} is {str(record.get(key))[:20]!r}")
    except FileNotFoundError:
        raise InputError(f"{path}: no such file; {cure}") from None
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: damaged ({reason(error)}); {cure}") from None
    return record


def check_format(path: Path, record: Mapping[str, Any]) -> None:
    """InputError if a file was written in a format later than FORMAT, ValueError if its number is
    none; files of before 0.1.0 have no number, which is format 0."""
    number = record.get(FORMAT_KEY, 0)
    if type(number) is not int:
        raise ValueError(f"{FORMAT_KEY} is {str(number)[:20]!r}")
    if number > FORMAT:
        raise InputError(
            f"{path}: has format {number}, and this clsplat reads formats up to "
            f"{FORMAT}; install the newer clsplat that wrote it"
        )


def with_format(record: Mapping[str, Any]) -> dict[str, Any]:
    """A record with the number of this format, in the last place."""
    return {**record, FORMAT_KEY: FORMAT}


def write_object(path: Path, record: dict[str, Any], indent: int = 1) -> None:
    """Replace a JSON file by a dict, whose numbers must be finite."""
    with replacing(path) as file:
        file.write((json.dumps(record, indent=indent, allow_nan=False) + "\n").encode())


def _finite(text: str) -> float:
    value = float(text)
    if not abs(value) <= LARGEST_NUMBER:
        raise ValueError(f"{text[:20]} is not a finite number")
    return value


def _integer(text: str) -> int:
    _finite(text)
    return int(text)


def plain(value: Any) -> Any:
    """Convert a value for JSON: numpy values to Python's, numbers that are not finite to None."""
    if isinstance(value, dict):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, (np.ndarray, np.generic)):
        return plain(value.tolist())
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    if isinstance(value, (str, Path)):  # names that are not Unicode are escaped
        return str(value).encode("utf-8", "backslashreplace").decode()
    if isinstance(value, float) and not np.isfinite(value):
        return None
    return value


def digest_of(path: str | Path) -> str:
    """SHA-256 of a file; "" if it cannot be read."""
    digest = hashlib.sha256()
    try:
        with open(path, "rb") as file:
            while part := file.read(1 << 20):
                digest.update(part)
    except OSError:
        return ""
    return digest.hexdigest()
