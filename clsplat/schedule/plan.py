"""What a schedule is told, and what it says of one step."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar

if TYPE_CHECKING:  # --help must not wait for numpy
    import numpy as np
    from numpy.typing import NDArray

    from clsplat.options import TrainOptions

EVERY = 100  # steps between rounds of growth, where nobody says otherwise


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
    parts : the parts of a training that it uses: "levels" (it changes the resolution), "spheres",
        "reprojection", and the `part` of its own options. It refuses options of other parts.
    Options : a frozen dataclass of its own options (options.py), or None.
    selection : how growth chooses, "threshold", "highest" or "score" (densify/select.py).
    observe_every : steps between calls of `observe`.
    latest : what the last `observe` found, for the record.
    options : TrainOptions with scaled steps; may be replaced between steps (a time budget moves the
        end).
    facts : what is known of the scene.
    """

    levels: tuple[float, ...] = (1.0,)
    defaults: ClassVar[dict[str, Any]] = {}
    parts: ClassVar[frozenset[str]] = frozenset()
    Options: ClassVar[type | None] = None
    selection = "threshold"
    observe_every = 100
    latest: Any = None

    def __init__(self, options: TrainOptions, facts: SceneFacts) -> None:
        self.options, self.facts = options, facts

    @classmethod
    def grows_until(cls, options: TrainOptions) -> int:
        """The last step that may grow, where the `densify_until` of these options is auto: half of
        the run."""
        return options.iterations // 2

    @classmethod
    def grows_every(cls, options: TrainOptions) -> int:
        """Steps between rounds of growth, where the `densify_every` of these options is auto; 0:
        `plan` decides."""
        return EVERY

    @classmethod
    def planned_levels(cls, options: TrainOptions, size: tuple[int, int]
                       ) -> tuple[tuple[float, ...] | None, str]:
        """(levels or None where only training finds them, a sentence that says so).

        Parameters
        ----------
        options : with scaled steps.
        size : width and height of the smallest training image, pixels.
        """
        return cls.levels, f"{listed(cls.levels)}: {sizes_text(cls.levels, size)}"

    @classmethod
    def options_of_block(cls, options: TrainOptions) -> dict[str, Any]:
        """{option: value} that a block of a city changes of these options, since it begins with the
        gaussians of a coarse run."""
        return {}

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


def listed(levels: tuple[float, ...]) -> str:
    """Such as 4 2 1."""
    return " ".join(f"{level:g}" for level in levels)


def sizes_text(levels: tuple[float, ...], size: tuple[int, int]) -> str:
    """Levels' image sizes in words; size: width and height of the finest, pixels."""
    sizes = [f"{int(size[0] / level)} x {int(size[1] / level)}" for level in levels]
    return f"{sizes[0]} to {sizes[-1]} pixels" if len(sizes) > 1 else f"{sizes[0]} pixels"
