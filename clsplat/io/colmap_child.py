"""Reads a COLMAP model in a process of its own, and writes its arrays to standard output.

pycolmap aborts the whole process on some damaged models, and holds far more of every observation
than training needs; here it may do both without harm.
"""

import io
import json
import os
from pathlib import Path

import numpy as np
import pycolmap

PINHOLES = ("PINHOLE", "SIMPLE_PINHOLE")


def model_arrays(model):
    """The arrays of `checks.checked_scene`, and `distorted`, the camera models that are not
    pinholes. Images by name, points by number, so that the order never varies."""
    reconstruction = pycolmap.Reconstruction(model)
    names = {} if (Path(model) / "images.bin").exists() else text_names(Path(model) / "images.txt")
    names = {i: names.get(i, reconstruction.images[i].name)
             for i in reconstruction.reg_image_ids()}
    images = [reconstruction.images[i] for i in sorted(names, key=names.get)]
    place = {image.image_id: number for number, image in enumerate(images)}
    cameras = [reconstruction.cameras[image.camera_id] for image in images]
    poses = np.array([image.cam_from_world().matrix() for image in images]).reshape(-1, 3, 4)
    points = [point for _, point in sorted(reconstruction.points3D.items())]
    return {
        "names": np.array([names[image.image_id] for image in images], dtype=np.str_),
        "rotations": poses[:, :, :3],
        "translations": poses[:, :, 3],
        "focals": _pairs([(c.focal_length_x, c.focal_length_y) for c in cameras]),
        "centres": _pairs([(c.principal_point_x, c.principal_point_y) for c in cameras]),
        "sizes": _pairs([(c.width, c.height) for c in cameras]).astype(np.int64),
        "points": np.array([point.xyz for point in points], np.float64).reshape(-1, 3),
        "colours": np.array([point.color for point in points], np.uint8).reshape(-1, 3),
        "observations": np.array(
            [(number, place[element.image_id]) for number, point in enumerate(points)
             for element in point.track.elements if element.image_id in place],
            np.int32).reshape(-1, 2),
        "distorted": np.array(sorted({c.model_name for c in cameras} - set(PINHOLES)),
                              dtype=np.str_),
    }


def _pairs(values):
    return np.array(values, np.float64).reshape(-1, 2)


def text_names(path):
    """{number: name} of images.txt: COLMAP writes names with blanks there, but reads them only up
    to the first one."""
    names = {}
    with open(path, encoding="utf-8") as lines:
        for line in lines:
            fields = line.strip().split(maxsplit=9)
            if not fields or fields[0].startswith("#"):
                continue
            if len(fields) > 9:
                names[int(fields[0])] = fields[9]
            next(lines, None)  # what the image observes
    return names


def encoded(arrays):
    """{name: array} as bytes: a line of JSON with the names, then each as .npy."""
    out = io.BytesIO(json.dumps(list(arrays)).encode() + b"\n")
    out.seek(0, io.SEEK_END)
    for array in arrays.values():
        np.lib.format.write_array(out, array, allow_pickle=False)
    return out.getbuffer()


def main(model):
    """Write the arrays of a model folder to standard output, `encoded`."""
    out = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what else is printed goes where complaints go
    os.chdir(model)  # pycolmap takes no name that is not UTF-8
    out.write(encoded(model_arrays(".")))
    out.close()
