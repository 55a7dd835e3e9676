"""A made-up cloud of gaussians of every orientation, colour and opacity."""

import numpy as np

from clsplat.gaussians import LEARNED, Gaussians


def cloud(count=60, sh_degree=3, seed=0, size=0.12, offset=(0.0, 0.0, 0.0)):
    """Gaussians within about 1 of the local origin."""
    rng = np.random.default_rng(seed)
    rows = {field.name: rng.normal(size=(count, *field.row_shape(sh_degree))).astype(np.float32) for field in LEARNED}
    rows["positions"] *= 0.4
    rows["sh_rest"] *= 0.3
    rows["log_scales"] = (np.log(size) + 0.5 * rows["log_scales"]).astype(np.float32)
    return Gaussians(rows, sh_degree, np.array(offset, np.float64))
