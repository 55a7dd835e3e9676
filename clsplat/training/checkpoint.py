"""Checkpoints of a training: rows, moments, statistics, parts, schedule and clocks."""

import dataclasses
from collections.abc import Collection, Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.config.option import checked
from clsplat.errors import InputError, reason
from clsplat.gaussians import FIELDS, LEARNED, Field, Gaussians
from clsplat.io.runs.run import OPTIONS, RunFolder
from clsplat.optimise.adam import LAG
from clsplat.options import TrainOptions
from clsplat.primitives.gather import download_rows
from clsplat.training.budget import SAVED_A_SECOND, Deadline
from clsplat.training.model import checkpoint_bytes
from clsplat.training.recorder import Clock, broken
from clsplat.training.session import Session

Arrays = dict[str, NDArray[Any]]
Saved = tuple[Arrays, dict[str, Any]]  # the arrays and the state

BY_GAUSSIAN = "row", "m", "v"  # kinds of the arrays with a row a gaussian, besides statistics
KINDS = *BY_GAUSSIAN, "adam", "statistics"  # of the arrays that no part has
STATISTICS = "grad_norm_sum", "seen_count"
REALS = (np.float32, np.float64)  # precisions of devices


class Checkpoint:
    """The checkpoint of a run, from which a session resumes to the same bytes."""

    def __init__(
        self, run: RunFolder, session: Session, clock: Clock, deadline: Deadline | None, fingerprint: str
    ) -> None:
        self.run, self.session, self.clock = run, session, clock
        self.deadline, self.fingerprint = deadline, fingerprint

    def taken(self) -> Saved:
        """The arrays, with the rows that the run saves, and the state, while the clock is paused;
        InputError where a value is not finite."""
        session, step = self.session, self.session.step
        model, statistics = step.model, step.statistics
        rows = self.run.saved_rows(session.iteration, lambda: model.field("positions"))
        m, v = model.adam.download(rows)
        kinds = {
            "row": model.stored(rows),
            "m": m,
            "v": v,
            "adam": model.adam.lag(),
            "statistics": {name: download_rows(session.device, getattr(statistics, name), rows) for name in STATISTICS},
            **{part.name: part.state() for part in session.parts},
        }
        arrays = {f"{kind}.{name}": values for kind, fields in kinds.items() for name, values in fields.items()}
        self._check(arrays)
        skipped = step.skipped_before + step.skipped()[0]
        state = {
            "fingerprint": self.fingerprint,
            "iteration": session.iteration,
            "level": session.level,
            **self.clock.state(),
            "pixel_pairs": step.pixel_pairs,
            "schedule": session.schedule.state(),
            "skipped": {"total": skipped},
            "initial_count": session.schedule.facts.count,
            "budget": self.deadline and self.deadline.state(),
        }
        return arrays, state

    def expected_seconds(self) -> float:
        """About how long it takes to write the first one."""
        session = self.session
        return checkpoint_bytes(session.step.count, session.options.sh_degree) / SAVED_A_SECOND

    def save(self) -> None:
        """Write the checkpoint, while the clock is paused; where `taken` raises InputError, the
        previous one is kept."""
        self.run.save_checkpoint(*self.taken())

    def check_model(self, gaussians: Gaussians) -> None:
        """Raise InputError where a value of the gaussians is not finite."""
        self._check({f"row.{name}": values for name, values in gaussians.rows.items()})

    def remove(self) -> None:
        """Remove the checkpoint of a finished run that nobody resumes."""
        self.run.remove_checkpoint()

    def _check(self, arrays: Arrays) -> None:
        if bad := [name for name, values in arrays.items() if not _is_finite(values)]:
            raise broken(self.run, f"{', '.join(bad)} at step {self.session.iteration}: not finite")

    def load(self, arrays: Arrays, state: dict[str, Any]) -> None:
        """Restore all but the rows; KeyError names what the checkpoint lacks."""
        session, step = self.session, self.session.step
        known = {*KINDS, *(part.name for part in session.parts)}
        if lacking := sorted({name.partition(".")[0] for name in arrays} - known):
            raise InputError(f"{self.run.path}: was trained with the part {lacking[0]}; resume it with that too")
        session.use_level(state["level"])
        step.model.adam.upload(_fields(arrays, "m", LEARNED), _fields(arrays, "v", LEARNED))
        step.model.adam.load_lag({name: arrays[f"adam.{name}"] for name in LAG}, state["iteration"])
        for name in STATISTICS:
            getattr(step.statistics, name).write(arrays[f"statistics.{name}"])
        for part in session.parts:
            part.load(
                {name.partition(".")[2]: values for name, values in arrays.items() if name.startswith(f"{part.name}.")},
                session,
            )
        step.skipped_before = state["skipped"]["total"]
        step.pairs_before, session.iteration = state["pixel_pairs"], state["iteration"]
        self.clock.load(state)
        session.schedule.facts = dataclasses.replace(session.schedule.facts, count=state["initial_count"])
        session.schedule.load(state["schedule"])
        if self.deadline:
            self.deadline.load(state["budget"])


def saved_gaussians(run: RunFolder, record: dict[str, Any], arrays: Arrays) -> Gaussians:
    """The gaussians in the arrays of a run's checkpoint, in the units of training; `record` is
    option -> value. InputError if the checkpoint or the options are damaged."""
    try:
        degree = checked(TrainOptions, str(run.path / OPTIONS), "sh_degree", record["sh_degree"])
        check_arrays(arrays, degree)
    except (KeyError, ValueError) as error:
        raise damaged(run, error) from None
    carried = [field for field in FIELDS if f"row.{field.name}" in arrays]
    return Gaussians(_fields(arrays, "row", carried), degree)


def damaged(run: RunFolder, error: Exception) -> InputError:
    """The InputError of a checkpoint that lacks something."""
    return InputError(f"{run.path}: its checkpoint lacks a good {error}; start again with --overwrite")


def latest_model(run: RunFolder) -> Gaussians:
    """The finished model of a run, or else that of its last checkpoint, in original units;
    InputError if there is no checkpoint, or it or options.json is damaged."""
    if run.has_model:
        return run.load_model()
    record = run.read_options()
    gaussians = saved_gaussians(run, record, run.load_checkpoint()[0])
    try:
        return gaussians.scaled(float(record["extent"])).located(record["offset"])
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(
            f"{run.path}: options.json is damaged ({reason(error)}); start again with overwrite=True"
        ) from None


def check_arrays(arrays: Arrays, sh_degree: int, kinds: Collection[str] = BY_GAUSSIAN) -> None:
    """Check arrays of a checkpoint that have a row a gaussian: KeyError names one of these kinds
    that is missing, ValueError one that does not fit. Statistics tell how many there are."""
    count = arrays["statistics.seen_count"].size
    shapes = {
        f"{kind}.{field.name}": field.row_shape(sh_degree)
        for kind in kinds
        for field in FIELDS
        if field in LEARNED or kind == "row" and f"row.{field.name}" in arrays
    }
    for name, shape in {**shapes, "statistics.grad_norm_sum": ()}.items():
        values = arrays[name]
        if values.dtype not in REALS or values.shape != (count, *shape) or not _is_finite(values):
            raise ValueError(f"{name} ({values.dtype}{list(values.shape)}, or not finite)")


def _fields(arrays: Arrays, kind: str, fields: Iterable[Field]) -> Arrays:
    return {field.name: arrays[f"{kind}.{field.name}"] for field in fields}


def _is_finite(values: NDArray[Any]) -> bool:
    """Test the extremes, which are nan if any value is: this copies none of the gigabytes."""
    return bool(np.isfinite([values.min(initial=0), values.max(initial=0)]).all())
