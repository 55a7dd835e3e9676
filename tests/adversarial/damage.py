"""What is done to a case's files before its command, beyond what a shell line says well."""

import json
import struct
from pathlib import Path

import numpy as np
from PIL import Image

SIZE = (96, 64)
PHOTO = "sy/images/003.jpg"


def truncated(name, size):
    """The first `size` bytes; of a negative size, all but so many."""
    def setup(folder: Path):
        path = folder / name
        data = path.read_bytes()
        path.write_bytes(data[:size])
    return setup


def written(name, data):
    """A file with these bytes or this text, or what a function gives; its folder made."""
    def setup(folder, data=data):
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        data = data() if callable(data) else data
        path.write_bytes(data if isinstance(data, bytes) else data.encode())
    return setup


def flipped(name, place, bit=1):
    """One bit of a file changed, at a share of its length."""
    def setup(folder):
        data = bytearray((folder / name).read_bytes())
        data[int(place * (len(data) - 1))] ^= 1 << bit
        (folder / name).write_bytes(data)
    return setup


def edited(name, **values):
    """Keys of a JSON file replaced; a value that is a function gets the one before."""
    def setup(folder):
        path = folder / name
        record = json.loads(path.read_text())
        for key, value in values.items():
            record[key] = value(record.get(key)) if callable(value) else value
        path.write_text(json.dumps(record))
    return setup


def without(name, *keys):
    """Keys of a JSON file removed."""
    def setup(folder):
        path = folder / name
        record = json.loads(path.read_text())
        path.write_text(json.dumps({key: record[key] for key in record if key not in keys}))
    return setup


def photo(mode="RGB", size=SIZE, name=PHOTO, value=128, **how):
    """A photo of one colour in place of another; how: for Pillow's `save`."""
    def setup(folder):
        Image.new(mode, size, value if mode in ("L", "I;16", "F", "P", "1") else None).save(
            folder / name, **how)
    return setup


def photos(change):
    """Each photo of the scene replaced by `change` of its Pillow image."""
    def setup(folder):
        for path in sorted((folder / "sy/images").iterdir()):
            with Image.open(path) as image:
                image.load()
                changed = change(image)
            changed.save(path, quality=95)
    return setup


def all_of(*setups):
    """Several, one after the other."""
    def setup(folder):
        for each in setups:
            each(folder)
    return setup


COLUMNS = ["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", "opacity",
           "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"]


def header(count, columns=COLUMNS, kind="float", form="binary_little_endian", before=""):
    """The header of a PLY of gaussians, bytes."""
    lines = ["ply", f"format {form} 1.0", *([before] if before else []), f"element vertex {count}",
             *(f"property {kind} {name}" for name in columns), "end_header", ""]
    return "\n".join(lines).encode()


def ply(name="m.ply", count=8, columns=COLUMNS, head=None, tail=b"", **values):
    """A PLY of gaussians near the scene's centre; values: a column's, for all rows."""
    def setup(folder):
        rows = np.zeros((count, len(columns)), "<f4")
        for column, name_ in enumerate(columns):
            rows[:, column] = values.get(name_, {"rot_0": 1, "scale_0": -2, "scale_1": -2,
                                                 "scale_2": -2}.get(name_, 0))
        if columns and columns[0] == "x" and "x" not in values:
            rows[:, 0] = np.linspace(-1, 1, count)
        (folder / name).write_bytes((head or header(count, columns)) + rows.tobytes() + tail)
    return setup


def transforms(name="nerf", frames=None, **top):
    """The scene as a folder of transforms.json, with cameras on a ring; frames: function of the
    list of frames; top: keys of the file replaced, None leaves one out."""
    def setup(folder):
        root = folder / name
        (root / "images").mkdir(parents=True)
        rows = []
        for number in range(12):
            photo_name = f"images/{number:03d}.jpg"
            (root / photo_name).write_bytes((folder / "sy" / photo_name).read_bytes())
            angle = 2 * np.pi * number / 12
            back = np.array([np.cos(angle), np.sin(angle), 0.4])
            back /= np.linalg.norm(back)
            right = np.cross([0, 0, 1.0], back)
            right /= np.linalg.norm(right)
            pose = np.eye(4)
            pose[:3, :3] = np.stack([right, np.cross(back, right), back], axis=1)
            pose[:3, 3] = 4 * back
            rows.append({"file_path": photo_name, "transform_matrix": pose.tolist()})
        record = {"fl_x": 90.0, "w": SIZE[0], "h": SIZE[1], "frames": rows, **top}
        if frames:
            record["frames"] = frames(rows)
        (root / "transforms.json").write_text(json.dumps(
            {key: value for key, value in record.items() if value is not None}))
    return setup


def camera(kind=1, width=96, height=64, parameters=(90.0, 90.0, 48.0, 32.0)):
    """Another cameras.bin with one camera; kind: COLMAP's number of the model."""
    data = struct.pack("<QIiQQ", 1, 1, kind, width, height)
    return written("sy/sparse/0/cameras.bin",
                   data + struct.pack(f"<{len(parameters)}d", *parameters))
