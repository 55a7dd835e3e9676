"""A block as it is trained: an ordinary scene, and what the city adds to it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

from clsplat.cities.parts import FrozenRows, SampleWeights
from clsplat.io.runs.city import BlockFolder
from clsplat.io.scenes.read import read_scene
from clsplat.options import TrainOptions
from clsplat.partition.region import Region
from clsplat.response import Response
from clsplat.scene import Scene
from clsplat.training.part import Part
from clsplat.training.parts.exposures import PhotoResponses


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
        return cls(scene, region, visits, block.responses())

    def parts(self, options: TrainOptions) -> list[Part]:
        """What makes the training of `scene` that of the block.

        Parameters
        ----------
        options : of the training.
        """
        parts: list[Part] = [FrozenRows(self.region), SampleWeights(self.visits)]
        if options.exposure == "on" and self.responses:
            # blocks that learned their own would not agree
            parts.append(PhotoResponses(self.responses, learns=False))
        return parts
