"""What 3DGS-MCMC adds (Kheradmand et al. 2024): regularisation of the gaussians, and noise."""

from __future__ import annotations

from typing import TYPE_CHECKING

from clsplat.loss.options import RegulariseOptions
from clsplat.loss.regularise import regularise
from clsplat.optimise.noise import add_noise
from clsplat.training.part import Inputs, Now, Part, TrainingSample, ViewPass

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


class PositionNoise(Part):
    """Random steps of nearly transparent gaussians after Adam, in proportion to its rate."""

    name = "noise"

    @classmethod
    def is_used(cls, prepared: PreparedScene) -> bool:
        return bool(prepared.options.position_noise)

    def begin(self, session: Session) -> None:
        self._amount, self._seed = session.options.position_noise, session.options.seed

    def inputs(self, now: Now, sample: TrainingSample) -> Inputs:
        return {"amount": self._amount * now.rates["positions"], "now": now.iteration}

    def move(self, work: ViewPass, inputs: Inputs) -> None:
        add_noise(work.rows, inputs["amount"], inputs["now"], self._seed, work.counts, work.frozen)
