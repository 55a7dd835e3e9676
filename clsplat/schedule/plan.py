"""What a schedule is told, and what it says of one step."""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass

from clsplat.options import MOST_STEPS


@dataclass(frozen=True)
class Plan:
    """level: down-sampling factor of the training images; degree: of the harmonics; gathers:
    whether densification statistics are kept; grows, resets_opacity: what follows the step;
    decay: how far the decay of the position rate is, 0 to 1; regularises: weight of the
    reprojection loss, 0 where it is left out."""

    level: float
    degree: int
    gathers: bool
    grows: bool
    resets_opacity: bool
    prunes_large: bool
    decay: float
    regularises: float = 0.0


@dataclass(frozen=True, eq=False)
class Subject:
    """What a schedule may know of the scene before training.

    size: (width, height) of the smallest training image, pixels; count: initial gaussians;
    inverse_distance: mean of 1 / distance to the nearest other sparse point, 1 / world unit;
    photos: called without arguments, gives an iterator of all training photos uint8[3, H, W];
    pixels: in all of them.
    """

    size: tuple[int, int]
    count: int
    inverse_distance: float
    photos: Callable
    pixels: int


class Schedule:
    """What every schedule answers; `options`, a TrainOptions with scaled steps, may be replaced
    between steps (a time budget moves the end)."""

    levels = (1.0,)  # all factors, in the order they will come
    selection = "threshold"  # how growth chooses: threshold, highest or score (densify/select.py)
    look = 100  # steps between calls of `observe`
    latest = None  # what the last look found, for the record

    def __init__(self, options, subject):
        self.options, self.subject = options, subject

    def plan(self, iteration):
        """The Plan of a step, counted from 1."""
        raise NotImplementedError

    def target(self, iteration, count, above):
        """How many gaussians a round of growth may reach, or None for as many as deserve it.

        count: gaussians after this round's pruning; above: those beyond the growth threshold.
        """
        return None

    def spares_half(self, iteration):
        """Whether a round of growth prunes only half of its candidates."""
        return False

    def ahead(self, iteration):
        """[(level, steps)]: what is still to come after a step, by what is known now."""
        return [(self.levels[-1], self.options.iterations - iteration)]

    def observe(self, iteration, frequency):
        """Look at the scene frequency after a step; returns a decision to log, or None."""
        return None

    def state(self):
        """What a checkpoint must hold, for JSON."""
        return {}

    def load(self, state):
        """Take over what `state` returned."""

    def degree(self, iteration):
        """Of the harmonics: one more every `sh_every` steps."""
        return min(self.options.sh_degree, (iteration - 1) // self.options.sh_every)

    def decay(self, iteration):
        """Share of the position rate's decay: even over the run."""
        return min(1.0, (iteration - 1) / self.options.iterations)


STEP_COUNTS = ("iterations", "sh_every", "densify_from", "densify_until", "densify_every",
               "reset_every")
GROWS_UNTIL = {"sig": 1.0, "dash": 0.9}  # share of the run; half of it for the others
EVERY = 100  # steps between rounds of growth
TAMING_ROUNDS = 60  # ... but one in 500 of 30,000 steps, so many a run, under `taming`


def scaled_steps(options):
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
    scaled = {name: getattr(options, name) for name in STEP_COUNTS} | {
        "densify_until": until, "densify_every": every}
    scaled = {name: max(1, round(value * options.steps_scale)) if value else 0
              for name, value in scaled.items()}
    return dataclasses.replace(options, **scaled, steps_scale=1.0)


WHOLE = 7000  # steps from which on step counts are as given


def laid_over(options, iterations):
    """TrainOptions, as of `scaled_steps`, for a run of another length: the end of growth keeps its
    share of it, and step counts shrink with a run of fewer than WHOLE steps. No run has more than
    MOST_STEPS."""
    iterations = min(iterations, MOST_STEPS)
    shrink = min(1.0, iterations / min(WHOLE, options.iterations))
    counts = {name: max(1, round(getattr(options, name) * shrink)) if getattr(options, name) else 0
              for name in STEP_COUNTS}
    until = round(options.densify_until * iterations / options.iterations)
    return dataclasses.replace(options, **counts | {"iterations": iterations,
                                                    "densify_until": until})
