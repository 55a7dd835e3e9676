"""The step counts of a training: filled in, scaled, and laid over a run of another length."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Any

from clsplat.config.option import MOST_STEPS
from clsplat.schedule.registry import schedule_of

if TYPE_CHECKING:
    from clsplat.options import TrainOptions

STEP_COUNTS = ("iterations", "sh_every", "densify_from", "densify_until", "densify_every",
               "reset_every")
WHOLE = 7000  # steps from which on step counts are as given


def scaled_steps(options: TrainOptions) -> TrainOptions:
    """TrainOptions with every step count times `steps_scale`; where `densify_until` and
    `densify_every` are auto, the schedule fills them in first."""
    schedule = schedule_of(options.schedule)
    return _scaled(dataclasses.replace(
        options, densify_until=options.densify_until or schedule.grows_until(options),
        densify_every=options.densify_every or schedule.grows_every(options), steps_scale=1.0),
        options.steps_scale)


def laid_over(options: TrainOptions, iterations: int) -> TrainOptions:
    """TrainOptions, as of `scaled_steps`, for a run of another length: the end of growth keeps its
    share of it, and step counts shrink with a run of fewer than WHOLE steps. No run has more than
    MOST_STEPS."""
    iterations = min(iterations, MOST_STEPS)
    until = round(options.densify_until * iterations / options.iterations)
    return dataclasses.replace(
        _scaled(options, min(1.0, iterations / min(WHOLE, options.iterations))),
        iterations=iterations, densify_until=until)


def _scaled(options: TrainOptions, factor: float) -> TrainOptions:
    """Every step count that is not 0 times a factor, and at least 1."""
    counts = {name: getattr(options, name) for name in STEP_COUNTS}
    scaled: dict[str, Any] = {
        name: max(1, round(count * factor)) if count else 0 for name, count in counts.items()}
    return dataclasses.replace(options, **scaled)
