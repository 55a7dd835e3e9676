"""Gaussians that are not trained."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from clsplat.partition.blocks import trainable
from clsplat.training.part import Part, State

if TYPE_CHECKING:
    from clsplat.schedule.growth import Growth
    from clsplat.training.model import Model
    from clsplat.training.session import Session
    from clsplat.training.start.prepare import PreparedScene

Trains = Callable[..., NDArray[np.bool_]]


class FrozenRows(Part):
    """Freezes the gaussians that a block does not train.

    Parameters
    ----------
    trains : (positions, log_scales) float32[N, 3] -> bool[N], those that are trained; None: a
        session's block decides.
    """

    name = "frozen"

    def __init__(self, trains: Trains | None = None) -> None:
        self.trains = trains

    @classmethod
    def is_used(cls, prepared: PreparedScene) -> bool:
        """Whether the scene is a block."""
        return prepared.scene.region is not None

    def begin(self, session: Session) -> None:
        """As `Part.begin`."""
        self.trains = self.trains or functools.partial(trainable, session.scene)

    def rows_changed(self, model: Model, growth: Growth | None) -> None:
        """Freeze anew the rows that are new, or all."""
        assert self.trains  # since `begin`
        known = np.zeros(0, bool)
        if growth is not None and model.frozen is not None:
            known = model.frozen.download()[growth.source[:growth.unchanged]] > 0
        rows = (model.rows[name].download()[len(known):] for name in ("positions", "log_scales"))
        model.frozen = model.device.upload(
            np.concatenate([known, ~self.trains(*rows)]).astype(np.uint32))
        self._model = model

    def state(self) -> State:
        """As `Part.state`."""
        assert self._model.frozen is not None
        return {"rows": self._model.frozen.download()}

    def load(self, state: State, session: Session) -> None:
        """As `Part.load`."""
        assert self._model.frozen is not None
        self._model.frozen.write(state["rows"])
