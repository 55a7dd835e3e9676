"""The growth that may follow a training step: a round of the schedule, and the opacity reset."""

from collections.abc import Callable, Iterable

import numpy as np

from clsplat.densify.round import Round
from clsplat.densify.scores import SizedCamera, blending_weights, taming_scores
from clsplat.gaussians import FIELDS
from clsplat.schedule.plan import Plan, Schedule
from clsplat.training.part import ViewPass
from clsplat.training.step import Step

RESET_OPACITY = 0.01
ScoringViews = Callable[[], list[ViewPass]]
Cameras = Callable[[], Iterable[SizedCamera]]


def densify(
    step: Step, iteration: int, plan: Plan, schedule: Schedule, scoring_views: ScoringViews, cameras: Cameras
) -> dict[str, int] | None:
    """Do the round of growth and the opacity reset that follow a step.

    `scoring_views` returns some training views, and `cameras` those of all, for a schedule that
    renders them. Returns how many gaussians were cloned, split and pruned; None without growth.
    """
    event = grow(step, iteration, plan, schedule, scoring_views, cameras) if plan.grows else None
    if plan.resets_opacity:
        step.model.limit_opacity(np.log(RESET_OPACITY / (1 - RESET_OPACITY)))
    return event


def grow(
    step: Step, iteration: int, plan: Plan, schedule: Schedule, scoring_views: ScoringViews, cameras: Cameras
) -> dict[str, int]:
    """A round of growth; arguments and result as for `densify`."""
    step.release()  # what follows renders frames of other sizes
    renderer, model, options = step.renderer, step.model, step.options
    model.catch_up()
    if model.pages:  # growth replaces them, and until then needs their memory
        model.pages.leave()
    step.rows_changed()
    frozen = np.zeros(model.count, bool) if model.frozen is None else model.frozen.download() > 0
    rows = {
        field.name: model.rows[field.name].download()
        for field in FIELDS
        if field.name in model.rows and not field.name.startswith("sh_")
    }
    growth = schedule.grow(
        Round(
            iteration,
            rows,
            step.extent,
            options,
            plan.prunes_large,
            frozen,
            step.statistics.mean_gradient,
            lambda gradient: taming_scores(
                renderer, model.rows, scoring_views(), plan.degree, options.ssim_weight, gradient, model.seen
            ),
            lambda: blending_weights(renderer, model.rows, cameras()),
        )
    )
    step.replace_rows(growth)
    step.choose_room(True)
    return {"cloned": growth.cloned, "split": growth.split, "pruned": growth.pruned}
