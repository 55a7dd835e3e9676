"""What a schedule is told, and what it says of one step."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from clsplat.options import MOST_STEPS, TrainOptions


@dataclass(frozen=True)
class Plan:
    """What a schedule says of one step.

    Attributes
    ----------
    level : down-sampling factor of the training images, at least 1.
    degree : of the spherical harmonics.
    gathers : whether densification statistics are kept.
    grows : whether a round of growth follows the step.
    resets_opacity : whether an opacity reset follows the step.
    prunes_large : whether rounds of growth remove gaussians that are larger than prune_size.
    decay : how far the decay of the position rate is, 0 to 1.
    regularises : weight of the reprojection loss, 0 where it is left out.
    """

    level: float
    degree: int
    gathers: bool
    grows: bool
    resets_opacity: bool
    prunes_large: bool
    decay: float
    regularises: float = 0.0


@dataclass(frozen=True, eq=False)
class SceneFacts:
    """What a schedule may know of the scene before training.

    size: (width, height) of the smallest training image, pixels; count: initial gaussians;
    inverse_distance: mean of 1 / distance to the nearest other sparse point, 1 / world unit;
    photos: called without arguments, gives an iterator of all training photos uint8[3, H, W];
    pixels: in all of them.
    """

    size: tuple[int, int]
    count: int
    inverse_distance: float
    photos: Callable[[], Iterator[NDArray[np.uint8]]]
    pixels: int


class Schedule:
    """What every schedule answers; a subclass in another package becomes `--schedule NAME` by the
    entry point `NAME = MODULE:CLASS` in the group `clsplat.schedules`.

    Attributes
    ----------
    levels : all down-sampling factors, in the order they will come.
    defaults : options that the schedule sets unless the user does, by name.
    selection : how growth chooses, "threshold", "highest" or "score" (densify/select.py).
    observe_every : steps between calls of `observe`.
    latest : what the last `observe` found, for the record.
    options : TrainOptions with scaled steps; may be replaced between steps (a time budget moves the
        end).
    facts : what is known of the scene.
    """

    levels: tuple[float, ...] = (1.0,)
    defaults: ClassVar[dict[str, Any]] = {}
    selection = "threshold"
    observe_every = 100
    latest: Any = None

    def __init__(self, options: TrainOptions, facts: SceneFacts) -> None:
        self.options, self.facts = options, facts

    def plan(self, iteration: int) -> Plan:
        """The Plan of a step; iteration counts from 1."""
        raise NotImplementedError

    def target(self, iteration: int, count: int, above: int) -> int | None:
        """How many gaussians a round of growth after step `iteration` may reach, or None for as
        many as deserve it.

        Parameters
        ----------
        iteration : the step, from 1.
        count : gaussians after this round's pruning.
        above : those beyond the growth threshold.
        """
        return None

    def spares_half(self, iteration: int) -> bool:
        """Whether a round of growth, after step `iteration`, prunes only half of its candidates."""
        return False

    def ahead(self, iteration: int) -> list[tuple[float, int]]:
        """[(level, steps)]: what is still to come after step `iteration`, by what is known now."""
        return [(self.levels[-1], self.options.iterations - iteration)]

    def observe(self, iteration: int, frequency: dict[str, float]) -> dict[str, Any] | None:
        """Look at the scene frequency after step `iteration`; returns a decision to log, or None.

        Parameters
        ----------
        iteration : the step, from 1.
        frequency : name of a variant -> scene frequency, 1 / world unit.
        """
        return None

    def state(self) -> dict[str, Any]:
        """What a checkpoint must hold, for JSON."""
        return {}

    def load(self, state: dict[str, Any]) -> None:
        """Take over the `state` that a checkpoint held."""

    def degree(self, iteration: int) -> int:
        """Of the harmonics at step `iteration`: one more every `sh_every` steps."""
        return min(self.options.sh_degree, (iteration - 1) // self.options.sh_every)

    def decay(self, iteration: int) -> float:
        """Share of the position rate's decay at step `iteration`: even over the run."""
        return min(1.0, (iteration - 1) / self.options.iterations)


STEP_COUNTS = ("iterations", "sh_every", "densify_from", "densify_until", "densify_every",
               "reset_every")
GROWS_UNTIL = {"sig": 1.0, "dash": 0.9}  # share of the run; half of it for the others
EVERY = 100  # steps between rounds of growth
TAMING_ROUNDS = 60  # ... but one in 500 of 30,000 steps, so many a run, under `taming`


def scaled_steps(options: TrainOptions) -> TrainOptions:
    """TrainOptions with every step count times `steps_scale`, `densify_until` and `densify_every`
    filled in."""
    steps = options.iterations
    by_rounds = options.schedule == "sig" and options.rounds > 0
    share = 0.5 if options.schedule == "sig" and not by_rounds else GROWS_UNTIL.get(
        options.schedule, 0.5)
    until = options.densify_until or int(steps * share)
    every = options.densify_every or (
        0 if by_rounds else max(EVERY, steps // TAMING_ROUNDS) if options.schedule == "taming"
        else EVERY)
    scaled: dict[str, Any] = {name: getattr(options, name) for name in STEP_COUNTS} | {
        "densify_until": until, "densify_every": every}
    scaled = {name: max(1, round(value * options.steps_scale)) if value else 0
              for name, value in scaled.items()}
    return dataclasses.replace(options, **scaled, steps_scale=1.0)


WHOLE = 7000  # steps from which on step counts are as given


def laid_over(options: TrainOptions, iterations: int) -> TrainOptions:
    """TrainOptions, as of `scaled_steps`, for a run of another length: the end of growth keeps its
    share of it, and step counts shrink with a run of fewer than WHOLE steps. No run has more than
    MOST_STEPS."""
    iterations = min(iterations, MOST_STEPS)
    shrink = min(1.0, iterations / min(WHOLE, options.iterations))
    counts: dict[str, Any] = {
        name: max(1, round(getattr(options, name) * shrink)) if getattr(options, name) else 0
        for name in STEP_COUNTS}
    until = round(options.densify_until * iterations / options.iterations)
    return dataclasses.replace(options, **counts | {"iterations": iterations,
                                                    "densify_until": until})
