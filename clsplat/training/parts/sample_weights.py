"""How often each photo is trained on."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from clsplat.scene import View
from clsplat.training.part import Part

if TYPE_CHECKING:
    from clsplat.training.start.prepare import PreparedScene


class SampleWeights(Part):
    """Visits the photos of a block as often as they show it."""

    name = "weights"

    @classmethod
    def is_used(cls, prepared: PreparedScene) -> bool:
        """Whether some views are trained on more often than others."""
        return len({view.visits for view in prepared.train_views}) > 1

    def visits(self, views: Sequence[View]) -> NDArray[np.float64]:
        """As `Part.visits`."""
        return np.array([view.visits for view in views])
