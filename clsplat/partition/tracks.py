"""Which views see a cell, by the tracks of the sparse model."""

import numpy as np

OF_VIEW = 0.3  # of a view's points: a cell that holds more of them is given the view
OF_CELL = 0.1  # of a cell's points: a view that sees more of them is given to the cell


def seen_by_tracks(site, regions):
    """bool[B, V]: which views see each Region (SunshineWYC, BlockGaussian 2025): more than 0.3 of
    the view's points lie in the region, or more than 0.1 of the region's points are in the view."""
    sees = np.zeros((len(regions), len(site.views)), bool)
    of_view = np.bincount(site.view, minlength=len(site.views))
    coordinates = regions[0].space.to(site.points)
    for block, region in enumerate(regions):
        inside = region.holds(coordinates)
        shared = np.bincount(site.view[inside[site.point]], minlength=len(site.views))
        sees[block] = (shared > OF_VIEW * of_view) | (shared > OF_CELL * inside.sum())
    return sees
