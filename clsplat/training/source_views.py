"""The source views with which reference views are compared, for loss terms that need one."""

from collections.abc import Sequence

import numpy as np

from clsplat.camera import Camera
from clsplat.device import ArraySpec, Device
from clsplat.loss.exposure import Exposures
from clsplat.loss.reproject import pack_pairs


class SourceViews:
    """Pairs of a reference and a source view, with the transforms between them on the device.

    Parameters
    ----------
    device : of the training.
    neighbours : indices of the source views of each view (covisibility/source_views.py).
    exposures : colour transforms of the views, or None.
    seed : of the random choice of source views.

    Attributes
    ----------
    pairs : [(reference view, source view), ...].
    geometries : real[P, 12]; between pixels, at the present level (`loss.reproject.pack_pairs`).
    colours : real[P, 12]; from colours of the source photo to those of the reference photo.
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
        """The device arrays for these neighbours."""
        rows = ArraySpec((sum(map(len, neighbours)), 12))
        return {"geometries": rows, "colours": rows}

    def use(self, cameras: Sequence[Camera]) -> None:
        """Use the views' cameras at a level from now on."""
        self.geometries = pack_pairs(self.device, [(cameras[i], cameras[j]) for i, j in self.pairs])

    def compare_colours(self) -> None:
        """Update `colours`; called only after exposures are recentred, because it waits."""
        unchanged = np.tile(np.eye(3, 4).ravel(), (len(self.pairs), 1))
        self.colours = (self.exposures.between(self.pairs) if self.exposures
                        else self.device.upload(unchanged))

    def drawn(self, number: int, view: int) -> tuple[int, int] | None:
        """Choose a source view at random; the choice depends on the seed and `number` only.

        Parameters
        ----------
        number : how many views have been trained on, with this one.
        view : index of the reference view.

        Returns
        -------
        (row of the pair, index of the source view), or None for a view without source views.
        """
        count = len(self.neighbours[view])
        if not count:
            return None
        row = int(self._first[view] + np.random.default_rng([self.seed, 2, number]).integers(count))
        return row, self.pairs[row][1]
