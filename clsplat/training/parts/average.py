"""The finished gaussians are the mean of those of the last steps (Polyak and Juditsky 1992).

A step follows one photo, so the gaussians keep moving about the place on which all photos agree,
and their mean is nearer to it than those of any step. So they may also move faster: with larger
learning rates the mean of the last steps fits photos better that nobody trained on (Izmailov et al.
2018), though each of these steps alone does not (docs/evidence/schedules.md).
"""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from clsplat.device import Array
from clsplat.gaussians import LEARNED
from clsplat.training.part import Part, State

if TYPE_CHECKING:
    from clsplat.densify.grow import Growth
    from clsplat.schedule.plan import Plan
    from clsplat.training.model import Model
    from clsplat.training.session import Session
    from clsplat.training.start.prepare import PreparedScene

LEAST_EVERY = 50  # steps between samples: neighbouring steps differ little
MOST_SAMPLES = 24  # long runs take fewer, as paged harmonics come to the host for each


class Average(Part):
    """Sums of the learned fields over samples of the last steps, since the rows last became
    others."""

    name = "average"

    def __init__(self) -> None:
        self._sums: dict[str, Array | NDArray[Any]] = {}
        self._samples = 0
        self._model: Model | None = None

    @classmethod
    def is_used(cls, prepared: PreparedScene) -> bool:
        return prepared.options.average > 0

    def rows_changed(self, model: Model, growth: Growth | None) -> None:
        if growth:
            self._sums, self._samples = {}, 0

    def before_step(self, session: Session, plan: Plan) -> dict[str, Any] | None:
        done, options = session.iteration, session.options
        averaged = options.average * options.iterations
        every = max(LEAST_EVERY, int(averaged / MOST_SAMPLES))
        if done % every == 0 and done > options.iterations - averaged:
            self._add(session)
        return None

    def finish(self, session: Session) -> None:
        """Put the mean in the place of the gaussians that are trained."""
        self._add(session)
        model = session.model
        trained = np.ones(model.count, bool) if model.frozen is None else model.frozen.download() == 0
        for name, total in self._sums.items():
            values = on_host(total) / self._samples
            values[~trained] = model.field(name)[~trained]
            model.write(name, values)
        self._sums, self._samples = {}, 0  # if the run is resumed, the mean stays

    def _add(self, session: Session) -> None:
        model = self._model = session.model
        model.catch_up()
        for field in LEARNED:
            self._sums[field.name] = model.add_to(field.name, self._sums.get(field.name))
        self._samples += 1

    def state(self) -> State:
        if not (self._sums and self._model):
            return {}
        return {**{name: on_host(total) for name, total in self._sums.items()}, "samples": np.array(self._samples)}

    def load(self, state: State, session: Session) -> None:
        model = self._model = session.model
        if state:
            self._samples = int(state["samples"])
        self._sums = {
            name: values if model.pages else model.within(partial(model.device.upload, values))
            for name, values in state.items()
            if name != "samples"
        }


def on_host(total: Array | NDArray[Any]) -> NDArray[Any]:
    """A sum, wherever it is."""
    return total.download() if isinstance(total, Array) else total
