"""Random steps of nearly transparent gaussians, after each step of Adam (3DGS-MCMC)."""

from __future__ import annotations

from typing import TYPE_CHECKING

from clsplat.optimise.noise import add_noise
from clsplat.training.part import Inputs, Now, Part, TrainingSample, ViewPass

if TYPE_CHECKING:
    from clsplat.training.session import Session
    from clsplat.training.start.prepare import PreparedScene


class PositionNoise(Part):
    """Noise of the positions, in proportion to their learning rate."""

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
