"""Relative difference of a rendered depth from a depth map, under a Charbonnier penalty."""

import numpy as np

COVERED = 0.5
SOFTNESS = 0.01


def compare_depth(depth, transmittance, known):
    """loss, its gradients [H, W] by depth and by transmittance, and the relative errors [H, W],
    nan where a pixel does not count. known[H, W]: 0 where there is no depth."""
    cover = 1 - transmittance
    valid = (known > 0) & (cover > COVERED)
    z = np.divide(depth, cover, out=np.zeros(depth.shape), where=valid)
    error = np.divide(z, known, out=np.ones(depth.shape), where=valid) - 1
    loss = (np.sqrt(error**2 + SOFTNESS**2) - SOFTNESS).sum() / depth.size
    by_z = np.zeros(depth.shape)
    by_z[valid] = (error / np.sqrt(error**2 + SOFTNESS**2) / depth.size)[valid] / known[valid]
    by_depth = np.divide(by_z, cover, out=np.zeros(depth.shape), where=valid)
    return loss, by_depth, by_depth * z, np.where(valid, error, np.nan)
