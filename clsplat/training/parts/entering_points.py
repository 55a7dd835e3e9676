"""Dense points enter a training with its levels.

An image at a level of 4 has a sixteenth of the pixels, and can determine a sixteenth of the
gaussians (the sampling argument of Xue et al. 2026, section 3). So a coarser level begins with
points that are merged in cells as many times as large, and the gaussians of the next one take the
place of those that they were merged to: each with its own place, colour and size, changed as that
one was trained.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Future
from dataclasses import replace
from threading import Thread
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from clsplat.densify.grow import Growth
from clsplat.densify.sphere import with_spheres
from clsplat.gaussians import Gaussians
from clsplat.scene import Scene, View
from clsplat.schedule.plan import FEWEST_ENTERING, Plan, SceneFacts
from clsplat.schedule.registry import schedule_of
from clsplat.stereo.dense_points import Points, coarser
from clsplat.training.part import Part, State

if TYPE_CHECKING:
    from clsplat.options import ScheduledOptions
    from clsplat.training.session import Session
    from clsplat.training.start.prepare import PreparedScene
    from clsplat.training.step import Step

CHANGED = "positions", "sh_constant", "log_scales"  # rows whose training the next level takes over
STATE = "positions", "colours", "sizes", "pixels"  # of the points of the finest level


class EnteringPoints(Part):
    """The gaussians of this level and of those to come.

    `levels` and `nodes`, the initial gaussians of each, are from coarse to fine; `parents` has for
    each level but the first int64[N], what each gaussian was merged to.
    """

    name = "points"

    def __init__(self) -> None:
        self.levels: tuple[float, ...] = ()
        self.nodes: list[Future[Gaussians]] = []
        self.parents: list[NDArray[np.int64]] = []
        self._state: State = {}
        self._count = 0  # of the gaussians of the finest level

    @classmethod
    def is_used(cls, prepared: PreparedScene) -> bool:
        options = prepared.options
        return options.init == "dense" and schedule_of(options.schedule).points_enter

    def fill(self, state: State, levels: Sequence[float], options: ScheduledOptions) -> Gaussians:
        """Merge the points of the finest level; returns the gaussians of the coarsest.

        `state` has STATE: positions, float64[N, 3], colours, uint8[N, 3], the size of a pixel at
        each, float64[N], and that of a cell in pixels, float64[1]. The gaussians of levels to come
        are made in a thread, as most of the time goes to distances between the finest points.
        """
        self._state, self.levels, self.parents = state, tuple(levels), []
        position, colour, sizes, pixels = (state[name] for name in STATE)
        points = [Points(position, colour.astype(np.float64), sizes, np.ones(len(sizes), int))]
        for level in self.levels[-2::-1]:
            merged, parents = coarser(points[0], level * float(pixels[0]))
            if len(merged.sizes) < FEWEST_ENTERING:
                merged, parents = points[0], np.arange(len(points[0].sizes))
            points.insert(0, merged)
            self.parents.insert(0, parents)
        self._count, self.nodes = len(sizes), [Future() for _ in points]
        # a pool's thread would be waited for, half a minute of two million points, after Ctrl-C
        Thread(target=_make, args=(self.nodes[:], points, options), daemon=True).start()
        return self.nodes[0].result()

    def facts(self, facts: SceneFacts, scene: Scene, views: Sequence[View], gaussians: Gaussians | None) -> SceneFacts:
        return replace(facts, count=self._count)  # of all that will have entered

    def before_step(self, session: Session, plan: Plan) -> dict[str, Any] | None:
        entered = 0
        while self.nodes and self.levels[0] > plan.level:
            entered = self._enter(session.step)
        return {"entered": entered} if entered else None

    def _enter(self, step: Step) -> int:
        """Let the gaussians of the next level take the place of those that they were merged to;
        returns how many they are."""
        step.model.catch_up()
        (was, new), parents = (node.result().rows for node in self.nodes[:2]), self.parents[0]
        rows = {name: new[name] + (step.model.field(name) - was[name])[parents] for name in CHANGED}
        if "anchors" in new:
            rows |= {"anchors": rows["positions"], "max_offsets": new["max_offsets"]}
        step.replace_rows(
            Growth(
                parents.astype(np.uint32),
                0,
                0,
                0,
                0,
                {name: (0, values.astype(np.float32)) for name, values in rows.items()},
            )
        )
        self._drop_coarsest()
        return len(parents)

    def _drop_coarsest(self) -> None:
        del self.nodes[0], self.parents[0]
        self.levels = self.levels[1:]
        if len(self.nodes) == 1:  # nothing enters any more, and a gaussian takes 250 bytes here
            self.nodes, self._state = [], {}

    def state(self) -> State:
        return self._state

    def load(self, state: State, session: Session) -> None:
        if state:
            self.fill(state, session.schedule.levels, session.options)
            while self.nodes and self.levels[0] > session.level:
                self._drop_coarsest()


def _make(nodes: Sequence[Future[Gaussians]], points: Sequence[Points], options: ScheduledOptions) -> None:
    """Fill in the initial gaussians of all levels."""
    for node, each in zip(nodes, points):
        try:
            node.set_result(_gaussians(each, options))
        except BaseException as error:  # noqa: BLE001  (raised where the result is asked for)
            node.set_exception(error)


def _gaussians(points: Points, options: ScheduledOptions) -> Gaussians:
    """The initial gaussians at points."""
    gaussians = Gaussians.from_points(points.positions, points.colours.round().astype(np.uint8), options.sh_degree)
    if options.sphere and "spheres" in schedule_of(options.schedule).parts:
        return with_spheres(gaussians, options.sphere_neighbours)
    return gaussians
