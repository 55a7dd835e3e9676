"""Which gaussians a camera sees, from their splats."""

import numpy as np

ALPHA_MIN = 1 / 255


def cull(splats, camera, near):
    """bool[N]: those whose footprint at its cutoff meets the image, none of whose values is
    infinite or nan; `splats` as `project` makes them before it clears the others."""
    low = splats["means"] - splats["extents"]
    high = splats["means"] + splats["extents"]
    visible = (splats["depths"] > near) & (splats["opacities"] > ALPHA_MIN)
    visible &= (high >= 0).all(1) & (low <= [camera["width"], camera["height"]]).all(1)
    for values in splats.values():
        visible &= np.isfinite(values).all(tuple(range(1, values.ndim)))
    return visible
