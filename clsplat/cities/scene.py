"""A block as it is trained: an ordinary scene, and the parts of its training that the city adds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from clsplat.densify.grow import Growth
from clsplat.gaussians import Gaussians
from clsplat.io.runs.city import BlockFolder
from clsplat.io.runs.run import read_exposures
from clsplat.io.scenes.read import read_scene
from clsplat.partition.blocks import seen_pixels, trainable
from clsplat.partition.region import Region
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
        """What makes the training of `scene` that of the block; `exposures`: whether it has them.
        """
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

    def facts(self, facts: SceneFacts, scene: Scene, views: Sequence[View],
              gaussians: Gaussians | None) -> SceneFacts:
        """As `Part.facts`: the pixels that show what the block reaches, and what it trains there.
        """
        if gaussians is None:
            return replace(facts, pixels=seen_pixels(scene, self.region, views))
        return replace(facts, count=int(trainable(
            scene, self.region, gaussians.positions, gaussians.log_scales).sum()))

    def begin(self, session: Session) -> None:
        """As `Part.begin`."""
        self._scene = session.scene

    def rows_changed(self, model: Model, growth: Growth | None) -> None:
        """Freeze rows that are new; without growth those that have left what the block trains, as
        frozen ones have not moved."""
        frozen, first = np.zeros(model.count, bool), 0
        if model.frozen is not None:
            before = model.frozen.download() > 0
            if growth is None:
                frozen = before
            else:
                first = growth.unchanged
                frozen[:first] = before[growth.source[:first]]
        moved = ~frozen[first:]
        positions, log_scales = (model.rows[name].download(first)[moved]
                                 for name in ("positions", "log_scales"))
        frozen[first:][moved] = ~trainable(self._scene, self.region, positions, log_scales)
        model.frozen = model.device.upload(frozen.astype(np.uint32))
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
