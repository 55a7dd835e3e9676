"""Which gaussians a block does not reach, and how large its views show them, in float64."""

import numpy as np

SHOWN_DEVIATIONS = 3.0  # from its centre, within which a view shows a gaussian


def in_cell(region, world):
    """bool[N]: which world points lie in a region's cell and margin."""
    space, margin = region.space, region.margin * region.side
    u = (world - space.origin) @ space.rotation.T / space.half
    if space.contracted:
        largest = np.maximum(np.abs(u).max(axis=1, keepdims=True), 1)
        u = (2 - 1 / largest) * u / largest / 4 + 0.5
    return ((u >= region.low - margin) & (u < region.high + margin)).all(axis=1)


def outside(scene, region, positions, log_scales, deviations):
    """bool[N]: which gaussians a region does not reach with so many standard deviations."""
    world = scene.offset + scene.unit * positions.astype(np.float64)
    spread = scene.unit * deviations * np.exp(log_scales.astype(np.float64).max(axis=1))
    steps = np.concatenate([np.zeros((1, 3)), *([axis, -axis] for axis in region.space.rotation[:2])])
    return ~np.all([in_cell(region, world + spread[:, None] * step) for step in steps], axis=0)


def sizes(scene, region, positions, log_scales, views, shown_deviations=SHOWN_DEVIATIONS):
    """[N]: 1 where the region reaches a gaussian, else its size in the view that shows it largest,
    two standard deviations, pixels, at most 1."""
    largest = (~outside(scene, region, positions, log_scales, 0.0)).astype(np.float64)
    scale = np.exp(np.max(log_scales, axis=1).astype(np.float64))
    for view in views:
        camera = view.camera
        pixels, depths = camera.project(positions.astype(np.float64))
        deviation = scale * max(camera.focal) / np.maximum(depths, scene.near_plane)
        is_shown = (depths > scene.near_plane) & camera.contains(pixels, shown_deviations * deviation)
        largest = np.maximum(largest, np.where(is_shown, 2 * deviation, 0))
    return np.minimum(largest, 1)
