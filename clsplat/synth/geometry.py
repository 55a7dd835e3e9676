"""The solids of a city: a ground plane, boxes that stand on it, and spheres.

In the world frame x and y are horizontal, z is up, the ground is at z = 0, and the origin is in the
middle of the city. One unit is about four metres.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from os import PathLike

import numpy as np
from numpy.typing import NDArray

from clsplat.io.atomic import replacing

BLOCK_WIDTH = 20.0  # distance between the centre lines of neighbouring streets
STREET = 2.5  # half the width of the road
PAVEMENT = 0.9  # width of the pavement on each side
LARGEST_COORDINATE = 1e15  # world units: squares stay finite
TOGETHER = 1 << 16  # solids times points whose distances are found at once, in the cache
KINDS = ("building", "plant", "car", "cabin", "trunk")  # of boxes, by texture


@dataclass(frozen=True, eq=False)
class City:
    """The solids of a city, in world units.

    Attributes
    ----------
    seed : the seed it was made from.
    blocks : the number of blocks along x and y.
    parks : [blocks along x, along y]; the blocks without buildings.
    boxes : [B, 2, 3]; low and high corners. Every box stands on the ground, even one on a roof.
    kinds : [B]; indices into KINDS.
    spheres : [S, 4]; centre and radius.
    """

    seed: int
    blocks: tuple[int, int]
    parks: NDArray[np.bool_]
    boxes: NDArray[np.float64]
    kinds: NDArray[np.integer]
    spheres: NDArray[np.float64]

    @property
    def extent(self) -> NDArray[np.float64]:
        """Half the size [2] of the built area, which reaches from -extent to extent."""
        return np.array(self.blocks) * BLOCK_WIDTH / 2 + STREET + PAVEMENT

    @property
    def bounds(self) -> NDArray[np.float64]:
        """Low and high corners [B + S, 2, 3] around each box, then around each sphere."""
        centre, radius = self.spheres[:, :3], self.spheres[:, 3:]
        return np.concatenate([self.boxes, np.stack([centre - radius, centre + radius], axis=1)])

    def part(self, kept: NDArray[np.bool_]) -> City:
        """The city with some of its solids, bool[B + S], in the order of `bounds`."""
        boxes, spheres = np.split(kept, [len(self.boxes)])
        return replace(self, boxes=self.boxes[boxes], kinds=self.kinds[boxes],
                       spheres=self.spheres[spheres])


def sample(city: City, count: int, margin: float, rng: np.random.Generator) -> NDArray[np.float64]:
    """Points [count, 3] that are sampled uniformly from the area of all surfaces.

    Parts of surfaces inside another solid are included, since the ray caster tells what is visible.

    Parameters
    ----------
    city : the solids.
    count : the number of points.
    margin : how far the ground reaches beyond the built area, world units.
    rng : the source of randomness.
    """
    size = city.boxes[:, 1] - city.boxes[:, 0]
    ground = city.extent + margin
    faces = np.stack([size[:, 1] * size[:, 2], size[:, 0] * size[:, 2],
                      size[:, 0] * size[:, 1] / 2], axis=1) * 2  # x sides, y sides, the top
    areas = np.concatenate([[4 * ground.prod()], faces.ravel(),
                            4 * np.pi * city.spheres[:, 3] ** 2])
    chosen = rng.choice(len(areas), size=count, p=areas / areas.sum())
    unit = rng.random((count, 3))
    side = rng.integers(0, 2, count)
    normal = rng.normal(size=(count, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)

    points = np.zeros((count, 3))
    on = chosen == 0
    points[on, :2] = (2 * unit[on, :2] - 1) * ground
    on = (chosen > 0) & (chosen <= faces.size)
    box, axis = np.divmod(chosen[on] - 1, 3)
    place = unit[on]
    place[np.arange(len(axis)), axis] = np.where(axis == 2, 1, side[on])
    points[on] = city.boxes[box, 0] + place * size[box]
    on = chosen > faces.size
    sphere = city.spheres[chosen[on] - 1 - faces.size]
    points[on] = sphere[:, :3] + normal[on] * sphere[:, 3:]
    return points


def save(city: City, path: str | PathLike[str]) -> None:
    """Write a city to `geometry.json`, the ground truth of a scene folder."""
    table = {
        "about": "ground truth: ground plane z = 0, boxes standing on it, spheres; z is up",
        "unit_metres": 4.0,
        "seed": city.seed,
        "blocks": list(city.blocks),
        "ground_extent": [(-city.extent).tolist(), city.extent.tolist()],
        "parks": city.parks.astype(int).tolist(),
        "boxes": [{"kind": KINDS[kind], "low": low.tolist(), "high": high.tolist()}
                  for kind, (low, high) in zip(city.kinds, city.boxes)],
        "spheres": [{"centre": row[:3].tolist(), "radius": row[3]} for row in city.spheres],
    }
    rows = json.dumps(table).replace('{"kind"', '\n{"kind"').replace('{"centre"', '\n{"centre"')
    with replacing(path) as file:
        file.write((rows + "\n").encode())
