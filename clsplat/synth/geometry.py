"""The solids of a city: a ground plane, boxes that stand on it, and spheres.

World frame: x and y horizontal, z up, ground at z = 0, origin under the middle of the city. One
unit is about four metres; a block with its street is BLOCK units wide.
"""

import json
import operator
from dataclasses import dataclass

import numpy as np

from clsplat.errors import InputError
from clsplat.io.atomic import replacing
from clsplat.io.reason import reason

BLOCK = 20.0  # distance between the centre lines of neighbouring streets
STREET = 2.5  # half the width of the carriageway
PAVEMENT = 0.9  # its width on each side
LARGEST = 1e15  # world units: squares stay finite
KINDS = ("building", "plant", "car", "cabin", "trunk")  # what a box is: decides its texture


@dataclass(frozen=True, eq=False)
class City:
    """Solids in world units.

    blocks: how many along x and y. parks: bool[blocks], blocks without buildings. boxes:
    float64[B, 2, 3], low and high corners; every box stands on the ground, also those that end on
    a roof. kinds: int[B], index into KINDS. spheres: float64[S, 4], centre and radius.
    """

    seed: int
    blocks: tuple[int, int]
    parks: np.ndarray
    boxes: np.ndarray
    kinds: np.ndarray
    spheres: np.ndarray

    @property
    def extent(self):
        """float64[2]: the built area reaches from -extent to extent along x and y."""
        return np.array(self.blocks) * BLOCK / 2 + STREET + PAVEMENT

    @property
    def bounds(self):
        """float64[B + S, 2, 3]: low and high corners around each box, then each sphere."""
        centre, radius = self.spheres[:, :3], self.spheres[:, 3:]
        return np.concatenate([self.boxes, np.stack([centre - radius, centre + radius], axis=1)])


def distance(city, points):
    """Unsigned distance float64[N] of points [N, 3] to the nearest true surface, world units.

    The city is one solid: ground below z = 0, united with the boxes and spheres. Exact outside it;
    inside it a lower bound, exact except where solids overlap.
    """
    points = np.asarray(points, np.float64)
    signed = points[:, 2].copy()
    for low, high in city.boxes:
        gap = np.maximum(low - points, points - high)
        gap[:, 2] = points[:, 2] - high[2]  # the underside of a box is no surface
        outside = np.linalg.norm(np.maximum(gap, 0), axis=1)
        np.minimum(signed, outside + np.minimum(gap.max(axis=1), 0), out=signed)
    for x, y, z, radius in city.spheres:
        np.minimum(signed, np.linalg.norm(points - (x, y, z), axis=1) - radius, out=signed)
    return np.abs(signed)


def sample(city, count, margin, rng):
    """`count` points float64[count, 3] drawn from all surfaces in proportion to their area.

    The ground counts up to `margin` units beyond the built area. Parts that overlap inside another
    solid are included: whether a point is seen is for the ray caster to say.
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


def save(city, path):
    """Write `geometry.json`, the ground truth of a scene folder."""
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


def load(path):
    """The City that `save` wrote; InputError where the file is missing or damaged."""
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


def _numbers(table, shape):
    """`table`, nested lists, as float64 of a shape; ValueError for what is no number of a city."""
    numbers = np.array(table, np.float64).reshape(shape)
    if not (np.abs(numbers) <= LARGEST).all():
        raise ValueError(f"numbers beyond {LARGEST:g}")
    return numbers
