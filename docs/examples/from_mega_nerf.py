"""Describe a Mega-NeRF folder (Turki et al. 2022) for clsplat: python from_mega_nerf.py FOLDER

Mill 19 and UrbanScene3D come in such folders. This writes FOLDER/transforms_train.json and, for the
held-out photos, FOLDER/transforms_test.json; after that, `clsplat train FOLDER` works. It needs
PyTorch 2.6 or newer, which reads the metadata as plain data (`weights_only`). The world becomes
that of the COLMAP model from which the poses came: if you have that model, put it into
FOLDER/colmap/sparse/0, and the training starts from its points.
"""

import json
import sys
from pathlib import Path

import numpy as np
import torch

# world axes of Mega-NeRF: down, right, back; of COLMAP: right, down, forward
TURN = np.array([(0.0, 1.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, -1.0)])


def read(path):
    return torch.load(path, map_location="cpu", weights_only=True)


folder = Path(sys.argv[1])
frame = read(folder / "coordinates.pt")
origin, scale = np.array(frame["origin_drb"], np.float64), float(frame["pose_scale_factor"])
for part, name in (("train", "transforms_train.json"), ("val", "transforms_test.json")):
    frames = []
    for path in sorted((folder / part / "metadata").glob("*.pt")):
        photo = read(path)
        pose = np.array(photo["c2w"], np.float64)  # camera to world; camera axes right, up, back
        pose[:, 3] = pose[:, 3] * scale + origin
        intrinsics = np.array(photo["intrinsics"], np.float64).tolist()
        frames.append(
            {
                "file_path": f"{part}/rgbs/{path.stem}",
                "w": int(photo["W"]),
                "h": int(photo["H"]),
                **dict(zip(("fl_x", "fl_y", "cx", "cy"), intrinsics)),
                "transform_matrix": (TURN @ pose).tolist(),
            }
        )
    if frames:
        (folder / name).write_text(json.dumps({"frames": frames}), encoding="utf-8")
    print(f"{part}: {len(frames)} photos")
