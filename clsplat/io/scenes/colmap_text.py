"""The text form of a COLMAP sparse model; see `colmap_format`."""

import codecs
import re
from collections.abc import Callable, Iterator
from io import BufferedReader
from pathlib import Path
from typing import Any

import numpy as np

from clsplat.errors import InputError
from clsplat.io.reason import reason
from clsplat.io.regular import open_regular
from clsplat.io.scenes.colmap_format import CAMERA_MODELS, Camera, Image, Points


def read_text(path: Path, part: str) -> Any:
    """Read one part of a model, as `colmap_binary.read_binary` does."""
    with open_regular(path) as file:
        lines = _Lines(file, path)
        try:
            content = READERS[part](lines)
        except (ValueError, IndexError, OverflowError) as error:
            raise ValueError(lines.complaint(error)) from None
    if lines.is_cut_short:
        raise ValueError("cut short: its last line has no line end (add one if the file is whole)")
    return content


class _Lines:
    """The lines of a file that are neither empty nor comments."""

    def __init__(self, file: BufferedReader, path: Path) -> None:
        self.file, self.path = file, path
        self.number, self.last = 0, b""
        self.made_by_colmap = False

    def __iter__(self) -> Iterator[bytes]:
        for line in iter(self.skip, b""):
            self.made_by_colmap |= line.startswith(b"# Number of")
            if line.strip() and not line.lstrip().startswith(b"#"):
                yield line

    def skip(self) -> bytes:
        """The next line, comments included; b"" at the end."""
        line = self.file.readline()
        if not self.number:
            line = line.removeprefix(codecs.BOM_UTF8)
        if line:
            self.number, self.last = self.number + 1, line
        if b"\0" in line:
            raise ValueError("not a text file")
        return line

    @property
    def is_cut_short(self) -> bool:
        """Whether the file lacks its last line end, which COLMAP always writes."""
        return self.made_by_colmap and not self.last.endswith(b"\n")

    def complaint(self, error: Exception) -> str:
        if self.is_cut_short:
            return f"cut short in line {self.number}"
        return f"line {self.number} is damaged ({reason(error)})"


def _read_cameras(lines: _Lines) -> dict[int, Camera]:
    cameras: dict[int, Camera] = {}
    for line in lines:
        number, model, width, height, *parameters = line.split()
        name = model.decode(errors="replace")
        if len(parameters) != CAMERA_MODELS.get(name):
            raise ValueError(f"{name[:40]!r} with {len(parameters)} parameters is not a camera "
                             "model")
        if int(number) in cameras:
            raise ValueError(f"camera {int(number)} occurs twice")
        cameras[int(number)] = Camera(name, int(width), int(height), tuple(map(float, parameters)))
    return cameras


def _read_images(lines: _Lines) -> list[Image]:
    images = []
    for line in lines:
        # a name may contain spaces: COLMAP writes them, though it reads names up to the first one
        fields = line.strip().split(maxsplit=9)
        if len(fields) != 10:
            raise ValueError(f"an image has {len(fields)} fields")
        number, *words, camera, name = fields
        pose = tuple(map(float, words))
        images.append(Image(_id(number), pose[:4], pose[4:], _id(camera), name.decode()))
        _check_observations(lines, images[-1])
    return images


def _check_observations(lines: _Lines, image: Image) -> None:
    """Skip the observations of an image, rows of x, y and the id of a point; InputError if the line
    is missing, as programs leave it out that have no observations."""
    line = lines.skip()
    fields = line.split(maxsplit=10)
    whole = len(fields) % 3 == 0 or len(fields) > 10
    if not whole or fields and not re.fullmatch(rb"-?\d+", line.rsplit(maxsplit=1)[-1]):
        if lines.is_cut_short:
            raise ValueError("cut short")
        raise InputError(f"{lines.path}: line {lines.number} is not the observations of image "
                         f"{image.name[:80]}: each image has two lines, of which the second may "
                         "be empty; add the empty lines, or export the model again")


def _id(text: bytes) -> int:
    """The id of an image or a camera; ValueError for one that COLMAP cannot have."""
    number = int(text)
    if not 0 <= number < 1 << 32:
        raise ValueError("an id is not a number of 32 bits")
    return number


def _read_points(lines: _Lines) -> Points:
    ids, positions, rgb, lengths = [], [], [], []
    images: list[int] = []
    for line in lines:
        fields = line.split()
        track = fields[8::2]
        if len(fields) < 8 or len(fields) % 2:
            raise ValueError(f"a point has {len(fields)} numbers")
        ids.append(int(fields[0]))
        positions.append([float(field) for field in fields[1:4]])
        rgb.append([int(field) for field in fields[4:7]])
        lengths.append(len(track))
        images += map(int, track)
    colours = np.array(rgb, np.int64).reshape(-1, 3)
    if ((colours < 0) | (colours > 255)).any():
        raise ValueError("a colour is not within 0 to 255")
    return Points(np.array(ids, np.int64), np.array(positions, np.float64).reshape(-1, 3),
                  colours.astype(np.uint8), np.array(lengths, np.int64),
                  np.array(images, np.int64))


READERS: dict[str, Callable[[_Lines], Any]] = {
    "cameras": _read_cameras, "images": _read_images, "points3D": _read_points}
