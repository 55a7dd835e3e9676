"""The finished gaussians are the mean of those of the last steps (Polyak and Juditsky 1992).

A step follows one photo, so the gaussians keep moving about the place on which all photos agree,
and their mean is nearer to it than those of any step. So they may also move faster: with larger
learning rates the mean of the last steps fits photos better that nobody trained on (Izmailov et al.
2018), though each of these steps alone does not (docs/evidence/schedules.md).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from clsplat.device import Array
from clsplat.gaussians import LEARNED
from clsplat.primitives.reduce import add_to
from clsplat.training.part import Part, State

if TYPE_CHECKING:
    from clsplat.schedule.plan import Plan
    from clsplat.training.session import Session
    from clsplat.training.start.prepare import PreparedScene

EVERY = 50  # steps between samples: neighbouring steps differ little


class Average(Part):
    """Sums of the learned fields over samples of the last steps, since the gaussians last became
    others."""

    name = "average"

    def __init__(self) -> None:
        self._sums: dict[str, Array] = {}
        self._samples = 0
        self._layout: object = None  # of the rows that were summed

    @classmethod
    def is_used(cls, prepared: PreparedScene) -> bool:
        return prepared.options.average > 0

    def before_step(self, session: Session, plan: Plan) -> dict[str, Any] | None:
        done, options = session.iteration, session.options
        if done % EVERY == 0 and done > (1 - options.average) * options.iterations:
            self._add(session)
        return None

    def finish(self, session: Session) -> None:
        """Put the mean in the place of the gaussians that are trained."""
        self._add(session)
        model = session.model
        trained = (np.ones(model.count, bool) if model.frozen is None
                   else model.frozen.download() == 0)
        for name, total in self._sums.items():
            row, values = model.rows[name], total.download() / self._samples
            values[~trained] = row.download()[~trained]
            row.write(values)
        self._sums, self._samples = {}, 0  # if the run is resumed, the mean stays

    def _add(self, session: Session) -> None:
        session.model.catch_up()
        if self._layout is not session.model.layout:  # the rows are others
            self._sums, self._samples, self._layout = {}, 0, session.model.layout
        for field in LEARNED:
            row = session.model.rows[field.name]
            if self._samples:
                add_to(row.device, self._sums[field.name], row)
            else:
                self._sums[field.name] = row.copied()
        self._samples += 1

    def state(self) -> State:
        sums: dict[str, NDArray[Any]] = {
            name: total.download() for name, total in self._sums.items()}
        return {**sums, "samples": np.array(self._samples)} if sums else {}

    def load(self, state: State, session: Session) -> None:
        if state:
            self._samples, self._layout = int(state["samples"]), session.model.layout
        self._sums = {name: session.device.upload(values) for name, values in state.items()
                      if name != "samples"}
