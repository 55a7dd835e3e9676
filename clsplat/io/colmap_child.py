"""Reads a COLMAP model in a process of its own: `python -m clsplat.io.colmap_child MODEL OUT.npz`.

pycolmap aborts the whole process on some damaged models, and holds far more of every observation
than training needs; here it may do both without harm.
"""

import sys

import numpy as np
import pycolmap

PINHOLES = ("PINHOLE", "SIMPLE_PINHOLE")


def model_arrays(model):
    """The arrays of `checks.checked_scene`, and `distorted`, the camera models that are not
    pinholes. Images by name, points by number, so that the order never varies."""
    reconstruction = pycolmap.Reconstruction(model)
    images = sorted((reconstruction.images[i] for i in reconstruction.reg_image_ids()),
                    key=lambda image: image.name)
    place = {image.image_id: number for number, image in enumerate(images)}
    cameras = [reconstruction.cameras[image.camera_id] for image in images]
    poses = np.array([image.cam_from_world().matrix() for image in images]).reshape(-1, 3, 4)
    points = [point for _, point in sorted(reconstruction.points3D.items())]
    return {
        "names": np.array([image.name for image in images], dtype=np.str_),
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


def main(model, out):
    """Write the arrays of a model folder to the file `out`, .npz."""
    np.savez(out, **model_arrays(model))


if __name__ == "__main__":
    main(*sys.argv[1:])
