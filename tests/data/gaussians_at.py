"""Gaussians of which a test names places and a few fields."""

import numpy as np

from clsplat.gaussians import FIELDS, Gaussians


def gaussians_at(positions, **rows):
    """Gaussians of degree 0 at places; fields that `rows` does not give are zero."""
    rows["positions"] = np.asarray(positions, np.float32).reshape(-1, 3)
    count = len(rows["positions"])
    return Gaussians({field.name: np.asarray(rows.get(field.name, np.zeros((
        count, *field.row_shape(0)))), np.float32) for field in FIELDS}, 0)
