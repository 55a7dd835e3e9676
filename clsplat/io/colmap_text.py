"""The text form of a COLMAP sparse model; see `colmap_format`."""

import numpy as np

from clsplat.io.colmap_format import CAMERA_MODELS, Camera, Image, Points
from clsplat.io.reason import reason
from clsplat.io.regular import open_regular


def read_text(path, part):
    """The cameras {number: Camera}, [Image] or Points of a file; ValueError says what is wrong."""
    with open_regular(path) as file:
        lines = _Lines(file)
        try:
            found = READERS[part](lines)
        except (ValueError, IndexError, OverflowError) as error:
            raise ValueError(lines.complaint(error)) from None
    if lines.made_by_colmap and not lines.last.endswith(b"\n"):
        raise ValueError("cut short: its last line has no end (end it if you know it is whole)")
    return found


class _Lines:
    """The lines of a file that are neither empty nor comments."""

    def __init__(self, file):
        self.file = file
        self.number, self.last = 0, b""
        self.made_by_colmap = False  # which ends every line

    def __iter__(self):
        for line in iter(self.skip, b""):
            self.made_by_colmap |= line.startswith(b"# Number of")
            if line.strip() and not line.lstrip().startswith(b"#"):
                yield line

    def skip(self):
        """The next line, whatever it is; b"" at the end."""
        line = self.file.readline()
        if line:
            self.number, self.last = self.number + 1, line
        if b"\0" in line:
            raise ValueError("not a text file")
        return line

    def complaint(self, error):
        if self.made_by_colmap and not self.last.endswith(b"\n"):
            return f"cut short in line {self.number}"
        return f"line {self.number} is damaged ({reason(error)})"


def _read_cameras(lines):
    cameras = {}
    for line in lines:
        number, model, width, height, *parameters = line.split()
        name = model.decode(errors="replace")
        if len(parameters) != CAMERA_MODELS.get(name):
            raise ValueError(f"{name[:40]!r} with {len(parameters)} parameters is no camera model")
        if int(number) in cameras:
            raise ValueError(f"camera {int(number)} is there twice")
        cameras[int(number)] = Camera(name, int(width), int(height), tuple(map(float, parameters)))
    return cameras


def _read_images(lines):
    images = []
    for line in lines:
        # a name may hold blanks: COLMAP writes them, though it reads names up to the first one
        number, *pose, camera, name = line.strip().split(maxsplit=9)
        pose = tuple(map(float, pose))
        images.append(Image(int(number), pose[:4], pose[4:], int(camera), name.decode()))
        lines.skip()  # what the image observes
    return images


def _read_points(lines):
    ids, positions, colours, lengths, images = [], [], [], [], []
    for line in lines:
        fields = line.split()
        track = fields[8::2]
        if len(fields) < 8 or len(fields) % 2:
            raise ValueError(f"a point with {len(fields)} numbers")
        ids.append(int(fields[0]))
        positions.append([float(field) for field in fields[1:4]])
        colours.append([int(field) for field in fields[4:7]])
        lengths.append(len(track))
        images += map(int, track)
    colours = np.array(colours, np.int64).reshape(-1, 3)
    if ((colours < 0) | (colours > 255)).any():
        raise ValueError("colours that are not of 0 to 255")
    return Points(np.array(ids, np.int64), np.array(positions, np.float64).reshape(-1, 3),
                  colours.astype(np.uint8), np.array(lengths, np.int64),
                  np.array(images, np.int64))


READERS = {"cameras": _read_cameras, "images": _read_images, "points3D": _read_points}
