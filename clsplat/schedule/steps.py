"""The step counts of a training: filled in, scaled, and fitted to a run of another length."""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING, Any, TypeVar

from clsplat.config.option import MOST_STEPS, is_auto
from clsplat.schedule.plan import SceneFacts
from clsplat.schedule.registry import schedule_of

if TYPE_CHECKING:
    from clsplat.options import RunOptions, ScheduledOptions

Options = TypeVar("Options", bound="ScheduledOptions")

STEP_COUNTS = ("iterations", "sh_every", "densify_from", "densify_until", "densify_every", "reset_every")
FULL_LENGTH = 7000  # steps; a shorter run has smaller step counts
PUBLISHED_LENGTH = 30_000  # steps, of 3DGS (Kerbl et al. 2023)
STEPS_A_PHOTO = 300  # steps a photo, after which held-out photos of small sets get worse: judge.md


def planned_steps(options: RunOptions, photos: int) -> tuple[int, str]:
    """The length of a run, before `steps_scale`, and a sentence with the reason.

    Few photos are learned in fewer steps than many, and more steps over-fit them.
    """
    if not is_auto(options.iterations):
        return options.iterations, f"{options.iterations:,}: requested"
    steps = min(max(STEPS_A_PHOTO * photos, FULL_LENGTH), PUBLISHED_LENGTH)
    if options.time_budget:
        return steps, f"as many as fit --time-budget {options.time_budget}"
    return steps, (
        f"{steps:,}: {STEPS_A_PHOTO} for each of {photos:,} training photos, but at "
        f"least {FULL_LENGTH:,} and at most {PUBLISHED_LENGTH:,}"
    )


def worthwhile_steps(
    options: ScheduledOptions, facts: SceneFacts, photos: int, is_stage: bool = False
) -> tuple[int, int, str]:
    """The length of a run that takes no more steps than its photos allow, before `steps_scale`; the
    most that they allow; and a sentence with the reason. The photos of a stage are not compared."""
    steps, reason = planned_steps(options, photos)
    most, fewer = (0, "") if is_stage else schedule_of(options.schedule).most_steps(options, facts, photos)
    if not most:
        return steps, MOST_STEPS, reason
    if options.time_budget:
        reason = f"{reason}, and at most {most:,} {fewer}"
    elif most < steps:
        reason = f"{most:,}: the most {fewer}; {steps:,} would over-fit them"
    return min(steps, most), most, reason


def scaled_steps(options: Options) -> Options:
    """Multiply every step count by `steps_scale`.

    Where `densify_until` and `densify_every` are auto, the schedule fills them in first.
    """
    schedule = schedule_of(options.schedule)
    return _scaled(
        dataclasses.replace(
            options,
            densify_until=options.densify_until or schedule.grows_until(options),
            densify_every=options.densify_every or schedule.grows_every(options),
            steps_scale=1.0,
        ),
        options.steps_scale,
    )


def laid_over(options: Options, iterations: int) -> Options:
    """Fit options, which `scaled_steps` returned, to a run of at most MOST_STEPS steps.

    The end of growth keeps its share of the run; the other step counts shrink with a run of fewer
    than FULL_LENGTH steps.
    """
    iterations = min(iterations, MOST_STEPS)
    until = round(options.densify_until * iterations / options.iterations)
    return dataclasses.replace(
        _scaled(options, min(1.0, iterations / min(FULL_LENGTH, options.iterations))),
        iterations=iterations,
        densify_until=until,
    )


def _scaled(options: Options, factor: float) -> Options:
    """Multiply every step count that is not 0 by a factor; the result is at least 1."""
    counts = {name: getattr(options, name) for name in STEP_COUNTS}
    scaled: dict[str, Any] = {name: max(1, round(count * factor)) if count else 0 for name, count in counts.items()}
    return dataclasses.replace(options, **scaled)
