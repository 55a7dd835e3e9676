"""Random steps of the positions (Kheradmand et al. 2024, eq. 8), in float64."""

import numpy as np

from tests.reference.project import rotations

SHARPNESS, OPACITY, LEAST = 100, 0.005, 1e-5


def hash_of(keys):
    """pcg4d of Jarzynski and Olano (2020): uint32[N, 4] from uint32[N, 4]."""
    v = keys.astype(np.uint32) * np.uint32(1664525) + np.uint32(1013904223)
    x, y, z, w = v.T
    for last in (False, True):
        x = x + y * w
        y = y + z * x
        z = z + x * y
        w = w + y * z
        if not last:
            x, y, z, w = (value ^ value >> np.uint32(16) for value in (x, y, z, w))
    return np.stack([x, y, z, w], axis=1)


def normal_numbers(count, now, seed):
    """float64[N, 3], by Box and Muller's transform of the hash of (row, now, seed, 0)."""
    keys = np.zeros((count, 4), np.uint32)
    keys[:, 0], keys[:, 1], keys[:, 2] = np.arange(count), now, seed
    u = ((hash_of(keys) >> np.uint32(9)) + 0.5) / 2**23
    radius, angle = np.sqrt(-2 * np.log(u[:, ::2])), 2 * np.pi * u[:, 1::2]
    return np.column_stack(
        [radius[:, 0] * np.cos(angle[:, 0]), radius[:, 0] * np.sin(angle[:, 0]), radius[:, 1] * np.cos(angle[:, 1])]
    )


def gate(logits):
    """How far a gaussian of such an opacity logit moves: 1 where transparent, 0 where opaque."""
    opacity = 1 / (1 + np.exp(-logits))
    return 1 / (1 + np.exp(SHARPNESS * (opacity - OPACITY)))


def noise(rows, amount, now, seed, frozen):
    """The positions float64[N, 3] after a random step.

    rows: field name -> float64[N, ...]; frozen: bool[N].
    """
    shares = gate(rows["opacity_logits"])
    turns, _, _ = rotations(rows["quaternions"])
    covariances = np.einsum("nij,nj,nkj->nik", turns, np.exp(2 * rows["log_scales"]), turns)
    eta = normal_numbers(len(shares), now, seed)
    moves = amount * shares[:, None] * np.einsum("nij,nj->ni", covariances, eta)
    moves[frozen | (shares < LEAST)] = 0
    return rows["positions"] + moves
