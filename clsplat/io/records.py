"""JSON records of a run folder, read back: strict, since a kill, a disk or a hand may change them.

What passes can be computed with, drawn and written again: numbers are finite, text is Unicode, and
the keys that reports rely on hold what they rely on.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np

from clsplat.io.atomic import replacing

LARGEST = 1e100  # of a number: sums of squares stay finite
# where they are there and not null, these are whole numbers, numbers, text, or objects
WHOLE = ("iteration", "gaussians", "views", "seed")
NUMBERS = ("train_seconds", "wall_seconds", "level", "psnr", "psnr_cc", "ssim", "ssim_cc", "lpips",
           "loss", "l1", "memory_bytes", "peak_bytes", "since", "slope", "threshold", "hits",
           "rounds", "pixel_pairs", "kernel_bytes")
TEXT = ("event", "scene", "fingerprint", "opencl_device", "kernel_form", "version", "commit",
        "schedule")
OBJECTS = ("reasons", "decisions")


def object_of(data: bytes) -> dict[str, Any]:
    """The dict of a JSON object, as bytes, with finite numbers and whole characters only; else
    ValueError."""
    try:
        table = json.loads(data, parse_constant=_finite, parse_float=_finite)
        # only escapes can hold half a character, which no file can
        if b"\\ud" in data.lower():
            json.dumps(table, ensure_ascii=False).encode()
    except RecursionError:
        raise ValueError("nested too deeply") from None
    if not isinstance(table, dict):
        raise ValueError("no object")
    return table


def record_of(data: bytes) -> dict[str, Any]:
    """The dict of options.json or of a line of metrics.jsonl, as bytes; ValueError names the key
    that holds what clsplat does not write."""
    record = object_of(data)
    for keys, kinds in ((WHOLE, int), (NUMBERS, (int, float)), (TEXT, str), (OBJECTS, dict)):
        for key in keys:
            value = record.get(key)
            if value is not None and not _is(value, kinds):
                raise ValueError(f"{key} is {str(value)[:20]!r}")
    if record.get("event") in ("step", "level"):
        frequency = record.get("frequency")  # of a step by variant and axis, else one
        values = frequency.values() if isinstance(frequency, dict) else [frequency]
        if isinstance(frequency, dict) != (record["event"] == "step") and frequency is not None:
            raise ValueError("frequency is of another event")
        if not all(value is None or _is(value, (int, float)) for value in values):
            raise ValueError("frequency is no number")
    return record


def write_object(path: Path, record: dict[str, Any], indent: int = 1) -> None:
    """Replace a JSON file by a dict, whose numbers are finite."""
    with replacing(path) as file:
        file.write((json.dumps(record, indent=indent, allow_nan=False) + "\n").encode())


def _is(value: object, kinds: Any) -> bool:
    if isinstance(value, bool):
        return False
    return isinstance(value, kinds) and (
        not isinstance(value, (int, float)) or abs(value) <= LARGEST)


def _finite(text: str) -> float:
    value = float(text)
    if not abs(value) <= LARGEST:
        raise ValueError(f"{text} is no number")
    return value


def plain(value: Any) -> Any:
    """What JSON can hold: numpy values as Python's, numbers that are not finite as None."""
    if isinstance(value, dict):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, (np.ndarray, np.generic)):
        return plain(value.tolist())
    if isinstance(value, (list, tuple)):
        return [plain(item) for item in value]
    if isinstance(value, (str, Path)):  # half characters, of names that are no Unicode, escaped
        return str(value).encode("utf-8", "backslashreplace").decode()
    if isinstance(value, float) and not np.isfinite(value):
        return None
    return value
