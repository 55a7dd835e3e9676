"""The source view that each reference view is compared with, where a loss term wants one."""

from collections.abc import Sequence

import numpy as np

from clsplat.camera import Camera
from clsplat.device import ArraySpec, Device
from clsplat.loss.exposure import Exposures
from clsplat.loss.reproject import pack_pairs


class SourceViews:
    """Pairs of a reference and a source view, and on the device what takes one to the other.

    Parameters
    ----------
    device : of the training.
    neighbours : of each view, the indices of its source views (covisibility/neighbours.py).
    exposures : colour transforms of the views, or None.
    seed : of the drawing.

    Attributes
    ----------
    pairs : [(reference view, source view), ...].
    geometries : real[P, 12], of the level that is used (`loss.reproject.pack_pairs`).
    colours : real[P, 12], from colours of the source photo to those of the reference photo.
    """

    def __init__(self, device: Device, neighbours: Sequence[Sequence[int]],
                 exposures: Exposures | None, seed: int) -> None:
        self.device, self.exposures, self.seed = device, exposures, seed
        self.neighbours = neighbours
        self.pairs = [(view, int(other)) for view, adjacent in enumerate(neighbours)
                      for other in adjacent]
        self._first = np.cumsum([0, *map(len, neighbours)])  # row of a view's first pair
        self.compare_colours()

    @staticmethod
    def arrays(neighbours: Sequence[Sequence[int]]) -> dict[str, ArraySpec]:
        """The arrays of so many source views."""
        rows = ArraySpec((sum(map(len, neighbours)), 12))
        return {"geometries": rows, "colours": rows}

    def use(self, cameras: Sequence[Camera]) -> None:
        """From now on the views' cameras are these, those of a level."""
        self.geometries = pack_pairs(self.device, [(cameras[i], cameras[j]) for i, j in self.pairs])

    def compare_colours(self) -> None:
        """To be called where exposures were recentred. At every step, it would make it wait."""
        unchanged = np.tile(np.eye(3, 4).ravel(), (len(self.pairs), 1))
        self.colours = (self.exposures.between(self.pairs) if self.exposures
                        else self.device.upload(unchanged))

    def drawn(self, number: int, view: int) -> tuple[int, int] | None:
        """(row of the pair, source view) for the number-th view trained on, which is `view`; None
        where it has no source view."""
        count = len(self.neighbours[view])
        if not count:
            return None
        row = int(self._first[view] + np.random.default_rng([self.seed, 2, number]).integers(count))
        return row, self.pairs[row][1]
