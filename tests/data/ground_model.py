"""A made-up scene for maps: level ground with a flat-roofed house, seen by cameras from above."""

import numpy as np

from clsplat.camera import Camera
from clsplat.constants import SH_C0
from clsplat.gaussians import Gaussians
from clsplat.georeference import Georeference
from clsplat.scene import Scene, View

SIDE, HOUSE, ROOF = 12.0, 3.0, 2.0  # half a side of the ground and of the house; its height
SPACING = 0.25
GROUND_RED, ROOF_BLUE = (0.8, 0.3, 0.2), (0.1, 0.2, 0.9)
OFFSET = np.array([100.0, -50.0, 7.0])  # original coordinates of the local origin
UTM = Georeference("EPSG:32633", (400_000.0, 5_700_000.0, 80.03), "made up", 0.1)


def model():
    """Flat, opaque gaussians on a grid: red ground at height 0, a blue roof at ROOF."""
    steps = np.arange(-SIDE, SIDE + SPACING / 2, SPACING)
    ground = np.stack([*np.meshgrid(steps, steps), np.zeros((len(steps),) * 2)], -1).reshape(-1, 3)
    roof = ground[abs(ground[:, :2]).max(axis=1) <= HOUSE] + (0, 0, ROOF)
    positions = np.concatenate([ground, roof])
    colours = np.where(positions[:, 2:] > 0, ROOF_BLUE, GROUND_RED)
    count = len(positions)
    return Gaussians(
        {
            "positions": positions.astype(np.float32),
            "sh_constant": ((colours - 0.5) / SH_C0).astype(np.float32),
            "sh_rest": np.zeros((count, 0, 3), np.float32),
            "opacity_logits": np.full(count, 3, np.float32),
            "log_scales": np.log(np.tile([0.8 * SPACING, 0.8 * SPACING, 0.01], (count, 1))).astype(np.float32),
            "quaternions": np.tile([1, 0, 0, 0], (count, 1)).astype(np.float32),
        },
        0,
        OFFSET,
    )


def scene(georeference=UTM, up=(0, 0, 1), width=200):
    """Nine cameras at a height of 20 that look straight down; points on the ground and the roof."""
    views = []
    for number, (x, y) in enumerate(np.ndindex(3, 3)):
        position = np.array([6.0 * (x - 1), 6.0 * (y - 1), 20.0])
        camera = Camera.looking_at(position - (0, 0, 1), position, up=(0, 1, 0), width=width, height=width, degrees=60)
        views.append(View(f"photo_{number}.jpg", camera, b""))
    points = model().positions.astype(np.float64)
    return Scene(
        "made",
        tuple(views),
        points,
        np.zeros((len(points), 3), np.uint8),
        OFFSET,
        georeference=georeference,
        given_up=np.asarray(up, float),
    )
