"""Gaussians of which a test names places and a few fields."""

import numpy as np

from clsplat.gaussians import Gaussians


def gaussians_at(positions, **rows):
    """Gaussians of degree 0 at places; fields that `rows` does not give are zero."""
    rows["positions"] = np.reshape(positions, (-1, 3))
    return Gaussians.padded({name: np.asarray(values, np.float32)
                             for name, values in rows.items()})
