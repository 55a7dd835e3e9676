"""The adjacent photo that each step's photo is compared with (regularise/reproject.py)."""

import numpy as np

from clsplat.loss.reproject import pack_pairs


class Adjacent:
    """Pairs of a view and one of its neighbours, and on the device what takes one to the other.

    neighbours: of each view, the indices of adjacent ones (covisibility/neighbours.py); exposures:
    loss.exposure.Exposures or None; seed: of the drawing.
    """

    def __init__(self, device, neighbours, exposures, seed):
        self.device, self.exposures, self.seed = device, exposures, seed
        self.neighbours = neighbours
        self.pairs = [(view, int(other)) for view, adjacent in enumerate(neighbours)
                      for other in adjacent]
        self.first = np.cumsum([0, *map(len, neighbours)])  # row of a view's first pair
        self.compare_colours()

    def use(self, cameras):
        """From now on the views' cameras are these, those of a level."""
        self.geometries = pack_pairs(self.device, [(cameras[i], cameras[j]) for i, j in self.pairs])

    def compare_colours(self):
        """To be called where exposures were recentred. At every step, it would make it wait."""
        unchanged = np.tile(np.eye(3, 4).ravel(), (len(self.pairs), 1))
        self.colours = (self.exposures.between(self.pairs) if self.exposures
                        else self.device.upload(unchanged))

    def drawn(self, number, view):
        """(row of the pair, index of the neighbour) for the number-th view trained on, which is
        `view`; (None, None) where it has none."""
        count = len(self.neighbours[view])
        if not count:
            return None, None
        row = int(self.first[view] + np.random.default_rng(
            [self.seed, 2, number]).integers(count))
        return row, self.pairs[row][1]
