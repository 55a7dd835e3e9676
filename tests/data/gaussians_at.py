"""Gaussians of which a test names places and a few fields."""

import numpy as np

from clsplat.gaussians import LEARNED, Gaussians


def gaussians_at(positions, **rows):
    """Gaussians of degree 0 at places; fields that `rows` does not give are zero."""
    positions = np.reshape(positions, (-1, 3))
    zeros = {field.name: np.zeros((len(positions), *field.row_shape(0))) for field in LEARNED}
    return Gaussians(
        {name: np.asarray(values, np.float32) for name, values in {**zeros, **rows, "positions": positions}.items()}, 0
    )
