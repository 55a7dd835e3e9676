"""Dense points enter a training with its levels.

An image at a level of 4 has a sixteenth of the pixels, and can determine a sixteenth of the
gaussians (the sampling argument of Xue et al. 2026, section 3). So a coarser level begins with
points that are merged in cells as many times as large, and the gaussians of the next one take the
place of those that they were merged to: each with its own place, colour and size, changed as that
one was trained.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from clsplat.constants import SH_C0
from clsplat.densify.grow import Growth
from clsplat.densify.sphere import with_spheres
from clsplat.gaussians import Gaussians
from clsplat.schedule.plan import Plan, Schedule
from clsplat.schedule.registry import schedule_of
from clsplat.stereo.dense_points import Points, coarser
from clsplat.training.part import Part, State

if TYPE_CHECKING:
    from clsplat.training.session import Session
    from clsplat.training.start.initialise import Start
    from clsplat.training.start.prepare import PreparedScene
    from clsplat.training.step import Step

FEWEST = 100  # points: the next finer level then begins at once
CHANGED = "positions", "sh_constant", "log_scales"  # rows whose training the next level takes over
Rows = dict[str, NDArray[np.floating]]


class EnteringPoints(Part):
    """The gaussians of this level and of those to come.

    `levels` and `nodes`, the initial gaussians of each as far as they differ, are from coarse to
    fine; `parents` has for each level but the first int64[N], what each gaussian was merged to.
    """

    name = "points"

    def __init__(self) -> None:
        self.levels: tuple[float, ...] = ()
        self.nodes: list[Rows] = []
        self.parents: list[NDArray[np.int64]] = []
        self._state: State = {}

    @classmethod
    def is_used(cls, prepared: PreparedScene) -> bool:
        options = prepared.options
        return options.init == "dense" and schedule_of(options.schedule).points_enter

    def fill(self, state: State, levels: Sequence[float], sh_degree: int, neighbours: int
             ) -> Gaussians:
        """Merge the gaussians of the finest level; returns those of the coarsest.

        `state` has their CHANGED rows and `max_offsets`, if they have spheres, the `sizes` of a
        pixel there, float64[N], and of a cell in `pixels`, float64[1]; the other arguments are
        options.
        """
        finest = {name: state[name] for name in (*CHANGED, "max_offsets") if name in state}
        self._state = {**finest, "sizes": state["sizes"], "pixels": state["pixels"]}
        self.levels, self.nodes, self.parents = tuple(levels), [finest], []
        points = Points(finest["positions"].astype(np.float64),
                        (finest["sh_constant"] * SH_C0 + 0.5) * 255.0, state["sizes"],
                        np.ones(len(state["sizes"]), int))
        for level in self.levels[-2::-1]:
            merged, parents = coarser(points, level * float(state["pixels"][0]))
            if len(merged.sizes) < FEWEST:
                merged, parents = points, np.arange(len(points.sizes))
            points = merged
            gaussians = Gaussians.from_points(
                points.positions, points.colours.clip(0, 255).round().astype(np.uint8),
                sh_degree)
            if "max_offsets" in finest:
                gaussians = with_spheres(gaussians, neighbours)
            self.nodes.insert(0, {name: gaussians.rows[name] for name in finest})
            self.parents.insert(0, parents)
        return gaussians

    def before_step(self, session: Session, plan: Plan) -> dict[str, Any] | None:
        entered = 0
        while len(self.nodes) > 1 and self.levels[0] > plan.level:
            entered = self._enter(session.step)
        return {"entered": entered} if entered else None

    def _enter(self, step: Step) -> int:
        """Let the gaussians of the next level take the place of those that they were merged to;
        returns how many they are."""
        step.model.catch_up()
        (was, new, *_), parents = self.nodes, self.parents[0]
        rows: Rows = {
            name: new[name] + (step.model.rows[name].download() - was[name])[parents]
            for name in CHANGED}
        if "max_offsets" in new:
            rows |= {"anchors": rows["positions"], "max_offsets": new["max_offsets"]}
        step.replace_rows(Growth(parents.astype(np.uint32), 0, 0, 0, 0, {
            name: (0, values.astype(np.float32)) for name, values in rows.items()}))
        self._drop_coarsest()
        return len(parents)

    def _drop_coarsest(self) -> None:
        del self.nodes[0], self.parents[0]
        self.levels = self.levels[1:]

    def state(self) -> State:
        return self._state if len(self.nodes) > 1 else {}

    def load(self, state: State, session: Session) -> None:
        if state:
            self.fill(state, session.schedule.levels, session.options.sh_degree,
                      session.options.sphere_neighbours)
            while self.levels[0] > session.level:
                self._drop_coarsest()


def entering(prepared: PreparedScene, start: Start, schedule: Schedule
             ) -> tuple[PreparedScene, Gaussians]:
    """The scene of a new training with this part, and the gaussians with which it begins; both as
    they are where points do not enter with the levels."""
    if not (start.dense and schedule.points_enter and len(schedule.levels) > 1):
        return prepared, start.gaussians
    part, options = EnteringPoints(), prepared.options
    gaussians = part.fill({**start.gaussians.rows, **start.dense}, schedule.levels,
                          options.sh_degree, options.sphere_neighbours)
    return replace(prepared, given=(*prepared.given, part)), gaussians
