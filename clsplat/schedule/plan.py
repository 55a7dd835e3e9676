"""The interface of a schedule: the facts that it knows, and the plan that it gives for a step."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

if TYPE_CHECKING:  # --help must not wait for numpy
    import numpy as np
    from numpy.typing import NDArray

    from clsplat.densify.grow import Growth
    from clsplat.densify.round import Round
    from clsplat.options import ScheduledOptions

LIMITS = (
    ("level", 1, 1e6),
    ("degree", 0, 3),
    ("decay", -1, math.inf),  # of a Plan
    ("regularises", 0, 1e6),
)
STEPS_A_ROUND = 100  # between rounds of growth, by default
# what schedules as published, also sig's, leave out
AS_PUBLISHED = {"exposure": "off", "average": 0.0, "opacity_weight": 0.0}
FEWEST_ENTERING = 100  # points at a level: where they are fewer, the next finer begins at once
USUAL_PHOTOS = 5.0  # that show a point


@dataclass(frozen=True)
class Plan:
    """What a schedule decides for one step.

    Attributes
    ----------
    level : down-sampling factor of the training images, at least 1.
    degree : degree of the spherical harmonics.
    gathers : whether the step adds to the densification statistics.
    grows : whether a round of growth follows the step; it uses the statistics gathered since the
        last round.
    resets_opacity : whether an opacity reset follows the step.
    prunes_large : whether a round of growth removes gaussians that are larger than prune_size.
    decay : progress of the decay of the position learning rate, 0 to 1.
    regularises : weight of the reprojection loss, 0 to leave it out.
    """

    level: float
    degree: int
    gathers: bool
    grows: bool
    resets_opacity: bool
    prunes_large: bool
    decay: float
    regularises: float = 0.0

    def __post_init__(self) -> None:
        """ValueError for what no training could do."""
        for name, low, high in LIMITS:
            value = getattr(self, name)
            if not low <= value <= high:
                raise ValueError(f"{name} {value} is not from {low:g} to {high:g}")


@dataclass(frozen=True, eq=False)
class SceneFacts:
    """What a schedule knows about the scene before training."""

    size: tuple[int, int]  # (width, height) of the smallest training image, pixels
    count: int  # number of initial gaussians
    # 1 / world unit; mean of 1 / distance to the nearest other sparse point
    inverse_distance: float
    # returns an iterator over all training photos uint8[3, H, W], which are read anew
    photos: Callable[[], Iterator[NDArray[np.uint8]]]
    pixels: int  # number of pixels in all training photos
    # returns the standard deviation of a place's colour over the photos that show it, a share of
    # full brightness (covisibility/photometry.py); nan: not known. Photos are read
    disagreement: Callable[[], float] = lambda: math.nan
    # mean number of training photos that show a sparse point, of the points that two or more show;
    # nan: not known
    shown_in: float = math.nan
    dense: bool = False  # whether training begins at dense points that enter with the levels

    def differing(self) -> str:
        """How much the photos disagree, as a clause."""
        differ = 100 * self.disagreement()
        return (
            f"as photos of a place differ by {differ:.1f} % of full brightness"
            if differ >= 0
            else "as no sparse point shows how much photos of a place differ"
        )


class Schedule:
    """Base class of all schedules.

    A schedule must define `plan`; everything else has a default. For each step the training calls,
    in this order: `plan`; `grow`, if the plan grows, in the round of growth that follows the step;
    `observe`, every `observe_every` steps. A schedule may keep state between
    the calls; `state` and `load` carry it through a checkpoint. `clsplat plan` drives the same
    methods without a model, so they must not depend on anything but their arguments.

    A subclass in another package becomes `--schedule NAME` by the entry point `NAME = MODULE:CLASS`
    in the group `clsplat.schedules`; docs/examples/halves.py is a complete one.

    In its methods, `options` are those of the training, `facts` what was measured of the scene,
    `photos` the number of training photos, and `iteration` is the number of a step, from 1.

    Attributes
    ----------
    levels : all down-sampling factors, in the order in which they come.
    defaults : name -> value of options that the schedule sets unless the user does.
    parts : parts of a training that the schedule uses: "levels" (it changes the resolution),
        "spheres", "reprojection", and the `part` of its own options. Options of other parts are
        refused.
    Options : frozen dataclass of the schedule's own options (config/option.py), or None.
    keeps : names of the attributes, of types that JSON has, that a checkpoint keeps.
    begins_dense : whether a training begins at dense points unless the options say otherwise.
    points_enter : whether dense points enter with the levels: a coarser one begins with what its
        pixels can determine (training/parts/entering_points.py).
    fills_target : whether a round of growth reaches its target, however few gaussians exceed the
        threshold; for forecasts.
    observe_every : steps between calls of `observe`.
    latest : values of the last `observe`, which metrics.jsonl records.
    options : of the training; a time budget replaces them between steps, as it moves the end.
    facts : what is known about the scene.
    """

    levels: tuple[float, ...] = (1.0,)
    defaults: ClassVar[dict[str, Any]] = {}
    parts: ClassVar[frozenset[str]] = frozenset()
    Options: ClassVar[type | None] = None
    keeps: ClassVar[tuple[str, ...]] = ()
    begins_dense: ClassVar[bool] = False
    points_enter: ClassVar[bool] = False
    fills_target: ClassVar[bool] = False
    observe_every = 100
    latest: Any = None

    def __init__(self, options: ScheduledOptions, facts: SceneFacts) -> None:
        self.options, self.facts = options, facts

    @classmethod
    def grows_until(cls, options: ScheduledOptions) -> int:
        """The value of `densify_until` if the options leave it at auto: half of the run."""
        return options.iterations // 2

    @classmethod
    def grows_every(cls, options: ScheduledOptions) -> int:
        """The value of `densify_every` if the options leave it at auto; 0 if `plan` decides."""
        return STEPS_A_ROUND

    @classmethod
    def planned_levels(cls, options: ScheduledOptions, facts: SceneFacts) -> tuple[tuple[float, ...] | None, str]:
        """(The levels that will come, or None if they are known only in training; a sentence for
        the user)."""
        return cls.levels, f"{listed(cls.levels)}: {sizes_text(cls.levels, facts.size)}"

    @classmethod
    def planned_limit(cls, options: ScheduledOptions, facts: SceneFacts) -> tuple[int | None, str]:
        """(Limit, sentence for the user): up to how many gaussians the model may grow at the finest
        level; None where the schedule has no limit."""
        return None, "none: the schedule has no limit"

    @classmethod
    def most_steps(cls, options: ScheduledOptions, facts: SceneFacts, photos: int) -> tuple[int, str]:
        """(Number, clause with the reason): the most steps that are worth taking, whatever the
        options ask for; 0: any number."""
        return 0, ""

    @classmethod
    def options_of_block(cls, options: ScheduledOptions, size: tuple[int, int], facts: SceneFacts) -> dict[str, Any]:
        """{option: value} that differ from `options` in a block of a city, which starts from a
        coarse run and takes as many steps as these; `facts` are about the whole, and `size` is
        (width, height) of the block's smallest training image, pixels."""
        return {}

    def plan(self, iteration: int) -> Plan:
        """Decide one step; called before each step, in order."""
        raise NotImplementedError

    def grow(self, round: Round) -> Growth:
        """Decide what becomes of each gaussian in a round of growth.

        This is the rule of 3DGS: of the gaussians whose screen gradient reaches the threshold,
        small ones are cloned and large ones split, those of the highest gradients first if `target`
        limits the round. Another rule makes another choice and returns `round.densify(choice)`, or
        `round.relocate(number)`. `round` has what is measured of the gaussians, and what can be
        made of them.
        """
        room = self.room(round, round.prunes)
        if room is not None:  # a split replaces a gaussian that is too large by two
            room -= int((round.prunes & round.above_threshold()).sum())
        return round.densify(round.above_threshold(room))

    def room(self, round: Round, prunes: NDArray[np.bool_]) -> int | None:
        """How many gaussians a round may add by `target` and the option `max_gaussians`; None: any
        number. `prunes` is bool[N], the gaussians that it removes."""
        counted = ~prunes & ~round.frozen
        count = int(counted.sum())
        above = int((counted & round.above_threshold()).sum())
        return round.room(self.target(round.iteration, count, above), count)

    def target(self, iteration: int, count: int, above: int) -> int | None:
        """The number of gaussians that the round after step `iteration` may reach; None: all that
        exceed the growth threshold grow. Called once in each round, by `room`; `count` gaussians
        are left by its pruning, and `above` of them exceed the threshold. Below `count` where a
        round only removes, for forecasts."""
        return None

    def ahead(self, iteration: int) -> list[tuple[float, float]]:
        """Predict the rest of the run after step `iteration`, as [(level, steps), ...].

        A time budget estimates the remaining time from this.
        """
        return [(self.levels[-1], self.options.iterations - iteration)]

    def observe(self, iteration: int, frequency: dict[str, float]) -> dict[str, Any] | None:
        """Take note of the scene frequency; called every `observe_every` steps, after the step.

        A schedule that follows the frequency changes its own state here, for the next `plan`.
        `frequency` is variant -> scene frequency, 1 / world unit (`training.frequency`). Returns
        values of a "level" record in metrics.jsonl, or None if nothing was decided.
        """
        return None

    def state(self) -> dict[str, Any]:
        """The attributes `keeps`, for a checkpoint."""
        return {name: getattr(self, name) for name in self.keeps}

    def load(self, state: dict[str, Any]) -> None:
        """Restore what `state` returned when the checkpoint was written."""
        vars(self).update(state)

    def degree(self, iteration: int) -> int:
        """Degree of the spherical harmonics at step `iteration`: one more every `sh_every`."""
        return min(self.options.sh_degree, (iteration - 1) // self.options.sh_every)

    def decay(self, iteration: int) -> float:
        """Progress of the position rate's decay at step `iteration`: even over the run."""
        return min(1.0, (iteration - 1) / self.options.iterations)


def listed(levels: tuple[float, ...]) -> str:
    """The levels as text, such as 4 2 1."""
    return " ".join(f"{level:g}" for level in levels)


def sizes_text(levels: tuple[float, ...], size: tuple[int, int]) -> str:
    """Image sizes of levels, coarse to fine, in words; `size` is (width, height) at level 1,
    pixels."""
    sizes = [f"{int(size[0] / level)} x {int(size[1] / level)}" for level in levels]
    return f"{sizes[0]} to {sizes[-1]} pixels" if len(sizes) > 1 else f"{sizes[0]} pixels"


def size_at(level: float) -> str:
    """The size of the photos at a level, in words, such as "1/3 size"."""
    return "full size" if level == 1 else f"1/{level:.3g} size"
