"""The solids of a city: a ground plane, boxes that stand on it, and spheres.

In the world frame x and y are horizontal, z is up, the ground is at z = 0, and the origin is in the
middle of the city. One unit is about four metres.
"""

from __future__ import annotations

import json
import operator
from dataclasses import dataclass, replace
from os import PathLike
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clsplat.errors import InputError
from clsplat.io.atomic import replacing
from clsplat.io.reason import reason

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


def distance(city: City, points: ArrayLike) -> NDArray[np.float64]:
    """The unsigned distance [N] of world points [N, 3] to the nearest true surface, world units.

    The city is one solid, the union of the ground below z = 0, the boxes and the spheres. The
    distance is exact outside it. Inside, it is a lower bound, exact except where solids overlap.
    """
    x, y, z = np.asarray(points, np.float64).T
    signed: NDArray[np.float64] = z.copy()
    at_once = max(1, TOGETHER // max(1, len(z)))
    for begin in range(0, len(city.boxes), at_once):
        low, high = city.boxes[begin:begin + at_once].transpose(1, 2, 0)[..., None]
        gaps = (np.maximum(low[0] - x, x - high[0]), np.maximum(low[1] - y, y - high[1]),
                z - high[2])  # the underside of a box is not a surface
        outside = np.sqrt(sum(np.maximum(gap, 0)**2 for gap in gaps))
        inside = np.minimum(np.maximum.reduce(gaps), 0)
        np.minimum(signed, (outside + inside).min(axis=0), out=signed)
    for begin in range(0, len(city.spheres), at_once):
        centre, radius = np.split(city.spheres[begin:begin + at_once].T[..., None], [3])
        away = np.sqrt((x - centre[0])**2 + (y - centre[1])**2 + (z - centre[2])**2) - radius[0]
        np.minimum(signed, away.min(axis=0), out=signed)
    return np.abs(signed)


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


def load(path: str | PathLike[str]) -> City:
    """The City that `save` wrote; InputError if the file is missing or damaged."""
    try:
        with open(path, encoding="utf-8") as file:
            table = json.load(file)
        columns, rows = (operator.index(number) for number in table["blocks"])
        return City(
            operator.index(table["seed"]), (columns, rows),
            _numbers(table["parks"], (columns, rows)).astype(bool),
            _numbers([[box["low"], box["high"]] for box in table["boxes"]], (-1, 2, 3)),
            np.array([KINDS.index(box["kind"]) for box in table["boxes"]], int),
            _numbers([[*row["centre"], row["radius"]] for row in table["spheres"]], (-1, 4)))
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); check its permissions"
                         ) from None
    except (ValueError, KeyError, TypeError, OverflowError, RecursionError) as error:
        raise InputError(f"{path}: not a geometry file of `clsplat synth` ({reason(error)}); "
                         "make the scene again") from None


def _numbers(table: Any, shape: tuple[int, ...]) -> NDArray[np.float64]:
    """Nested lists as an array of a shape; ValueError if they are not coordinates of a city."""
    numbers = np.array(table, np.float64).reshape(shape)
    if not (np.abs(numbers) <= LARGEST_COORDINATE).all():
        raise ValueError(f"numbers beyond {LARGEST_COORDINATE:g}")
    return numbers
