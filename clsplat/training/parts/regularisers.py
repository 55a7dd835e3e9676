"""Regularisation of the opacities and sizes of the gaussians that a view sees."""

from __future__ import annotations

from typing import TYPE_CHECKING

from clsplat.loss.options import RegulariseOptions
from clsplat.loss.regularise import regularise
from clsplat.training.part import Inputs, Part, ViewPass

if TYPE_CHECKING:
    from clsplat.training.session import Session
    from clsplat.training.start.prepare import PreparedScene


class Regularisers(Part):
    """Weights of the mean opacity and of the mean size of the gaussians that a view sees."""

    name = "regularise"
    Options = RegulariseOptions

    @classmethod
    def is_used(cls, prepared: PreparedScene) -> bool:
        return bool(prepared.options.opacity_weight or prepared.options.scale_weight)

    def begin(self, session: Session) -> None:
        self._weights = session.options.opacity_weight, session.options.scale_weight

    def learn(self, work: ViewPass, inputs: Inputs) -> None:
        regularise(work.rows, work.gradients, *self._weights)
