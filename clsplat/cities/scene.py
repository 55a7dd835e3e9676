"""A block as it is trained: an ordinary scene, and the parts of its training that the city adds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from clsplat.cities.choose import note_outside, trainable
from clsplat.densify.grow import Growth
from clsplat.gaussians import Gaussians
from clsplat.io.runs.city import BlockFolder
from clsplat.io.runs.run import read_exposures
from clsplat.io.scenes.read import read_scene
from clsplat.partition.region import Region
from clsplat.partition.windows import seen_pixels
from clsplat.primitives.gather import gather
from clsplat.response import Response
from clsplat.scene import Scene, View
from clsplat.schedule.plan import SceneFacts
from clsplat.training.model import Model
from clsplat.training.part import Part, State
from clsplat.training.parts.exposures import PhotoResponses
from clsplat.training.session import Session


@dataclass(frozen=True, eq=False)
class BlockScene:
    """A block of a city.

    Attributes
    ----------
    scene : its photos, each as far as it shows the block, and the points that these see.
    region : what it owns, and its margin.
    visits : name of a view -> how often a training visits it, in proportion to others.
    responses : of its views by name, from the coarse run; None: it learned none.
    """

    scene: Scene
    region: Region
    visits: Mapping[str, float]
    responses: Mapping[str, Response] | None

    @classmethod
    def read(cls, block: BlockFolder) -> BlockScene:
        """Read the block in a folder; the coarse run has shown the notes about the whole scene."""
        region, visits = block.region()
        scene = replace(read_scene(block.path), notes=())
        return cls(scene, region, visits, read_exposures(block.path))

    def parts(self, exposures: bool) -> list[Part]:
        """What makes the training of `scene` that of the block; `exposures`: whether it has them."""
        parts: list[Part] = [FrozenRows(self.region), SampleWeights(self.visits)]
        if exposures and self.responses:
            # blocks that learned their own would not agree
            parts.append(PhotoResponses(self.responses, learns=False))
        return parts


class Stage(Part):
    """The city decides about the training, and shows its result."""

    name = "stage"
    is_stage = True


class FrozenRows(Stage):
    """Freezes the gaussians that a block does not train."""

    name = "frozen"

    def __init__(self, region: Region) -> None:
        self.region = region

    def facts(self, facts: SceneFacts, scene: Scene, views: Sequence[View], gaussians: Gaussians | None) -> SceneFacts:
        """As `Part.facts`: the pixels that show what the block reaches, and what it trains there."""
        if gaussians is None:
            return replace(facts, pixels=seen_pixels(scene, self.region, views))
        return replace(facts, count=int(trainable(scene, self.region, gaussians.positions, gaussians.log_scales).sum()))

    def begin(self, session: Session) -> None:
        """As `Part.begin`."""
        self._scene = session.scene

    def rows_changed(self, model: Model, growth: Growth | None) -> None:
        """Freeze rows that the region does not reach; those that were frozen stay so, as they do
        not move."""
        before, device = model.frozen, model.device
        frozen = device.zeros(model.count, np.uint32) if before is None or growth else before
        if before is not None and growth:
            source = device.upload(growth.source[: growth.unchanged])
            gather(device, before, source, frozen)
        note_outside(device, self._scene, self.region, model.rows["positions"], model.rows["log_scales"], frozen)
        model.frozen = frozen
        self._model = model

    def state(self) -> State:
        """As `Part.state`."""
        assert self._model.frozen is not None
        return {"rows": self._model.frozen.download()}

    def load(self, state: State, session: Session) -> None:
        """As `Part.load`."""
        assert self._model.frozen is not None
        self._model.frozen.write(state["rows"])


class SampleWeights(Part):
    """Visits each photo of a block as often as it shows what the block owns.

    `weights` : how often, in any unit, by the name of a view; 1 for others."""

    name = "weights"

    def __init__(self, weights: Mapping[str, float]) -> None:
        self._weights = weights

    def visits(self, views: Sequence[View]) -> NDArray[np.float64]:
        """As `Part.visits`."""
        return np.array([self._weights.get(view.name, 1.0) for view in views])
