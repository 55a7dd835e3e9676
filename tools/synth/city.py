"""The solids of a city: a ground plane, boxes that stand on it, and spheres.

In the world frame x and y are horizontal, z is up, the ground is at z = 0, and the origin is in the
middle of the city. One unit is about four metres.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

BLOCK_WIDTH = 20.0  # distance between the centre lines of neighbouring streets
STREET = 2.5  # half the width of the road
PAVEMENT = 0.9  # width of the pavement on each side
KINDS = ("building", "plant", "car", "cabin", "trunk", "part")  # of boxes, by texture
UNIT_METRES = 4.0  # of a world unit
TALLEST_BUILDING = 12.0  # world units
INNER = BLOCK_WIDTH / 2 - STREET - PAVEMENT  # half the width of a block inside its pavement


@dataclass(frozen=True, eq=False)
class City:
    """The solids of a city, in world units."""

    seed: int  # it was made from this
    blocks: tuple[int, int]  # how many along x and y
    parks: NDArray[np.bool_]  # [blocks along x, along y]; the blocks without buildings
    # [B, 2, 3]; low and high corners. Every box stands on the ground, even one on a roof
    boxes: NDArray[np.float64]
    kinds: NDArray[np.integer]  # [B]; indices into KINDS
    spheres: NDArray[np.float64]  # [S, 4]; centre and radius

    @property
    def extent(self) -> NDArray[np.float64]:
        """Half the size [2] of the built area, which reaches from -extent to extent."""
        return np.array(self.blocks) * BLOCK_WIDTH / 2 + STREET + PAVEMENT

    @property
    def bounds(self) -> NDArray[np.float64]:
        """Low and high corners [B + S, 2, 3] around each box, then around each sphere."""
        centre, radius = self.spheres[:, :3], self.spheres[:, 3:]
        return np.concatenate([self.boxes, np.stack([centre - radius, centre + radius], axis=1)])


def lay_out(blocks: tuple[int, int] = (2, 2), seed: int = 0, small: bool = False) -> City:
    """A City of so many blocks along x and y; the same seed gives the same city. `small` : whether
    it has small parts, too: on roofs, in yards and along the streets."""
    builder = _Builder(np.random.default_rng([seed, 1]))
    parks = np.zeros(blocks, bool)
    if parks.size > 1:
        parks.flat[builder.rng.permutation(parks.size)[: max(1, parks.size // 6)]] = True
    for place in np.ndindex(*blocks):
        centre = (np.array(place) - (np.array(blocks) - 1) / 2) * BLOCK_WIDTH
        (builder.park if parks[place] else builder.houses)(centre)
        builder.pavement_trees(centre)
    builder.outskirts(blocks)
    for axis in (0, 1):
        for line in range(blocks[axis] + 1):
            builder.cars(axis, (line - blocks[axis] / 2) * BLOCK_WIDTH, blocks[1 - axis] * BLOCK_WIDTH / 2)
    if small:
        builder.rng = np.random.default_rng([seed, 5])  # the other solids stay as they are
        builder.roof_parts()
        for place in np.ndindex(*blocks):
            builder.street_parts((np.array(place) - (np.array(blocks) - 1) / 2) * BLOCK_WIDTH)
    # rounded, so that geometry.json has exactly the numbers that were rendered
    return City(
        seed,
        blocks,
        parks,
        np.round(np.array(builder.boxes), 3),
        np.array([KINDS.index(kind) for kind in builder.kinds]),
        np.round(np.array(builder.spheres).reshape(-1, 4), 3),
    )


class _Builder:
    """Collects solids; every method uses the one random generator in a fixed order."""

    def __init__(self, rng: np.random.Generator) -> None:
        self.rng = rng
        self.boxes: list[list[list[float]]] = []
        self.kinds: list[str] = []
        self.spheres: list[list[float]] = []

    def box(self, kind: str, centre: NDArray[np.float64], half: NDArray[np.float64], top: float) -> None:
        self.kinds.append(kind)
        self.boxes.append([[*(centre - half), 0.0], [*(centre + half), top]])

    def houses(self, centre: NDArray[np.float64]) -> None:
        """A block of four lots, each with a building or sometimes a small garden."""
        cut = self.rng.uniform(-0.25, 0.25, 3) * INNER
        first = self.rng.integers(0, 2)  # the axis of the cut that crosses the whole block
        gardens = self.rng.permutation(4)[: self.rng.integers(0, 2)]
        for lot in range(4):
            low, high = np.full(2, -INNER), np.full(2, INNER)
            for axis, at, upper in ((first, cut[0], lot & 1), (1 - first, cut[1 + (lot & 1)], lot >> 1)):
                (low if upper else high)[axis] = at
            low, high = low + 0.4, high - 0.4
            middle, half = centre + (low + high) / 2, (high - low) / 2
            if lot in gardens:
                for _ in range(4):
                    self.tree(middle + self.rng.uniform(-0.7, 0.7, 2) * half)
            else:
                self.building(middle, half * self.rng.uniform(0.8, 1.0, 2))

    def building(self, centre: NDArray[np.float64], half: NDArray[np.float64]) -> None:
        top = self.rng.uniform(3.0, 0.75 * TALLEST_BUILDING)
        self.box("building", centre, half, top)
        if top > 5 and self.rng.random() < 0.5:  # a narrower upper part
            half = half * self.rng.uniform(0.5, 0.75, 2)
            top += self.rng.uniform(1.5, 0.25 * TALLEST_BUILDING)
            self.box("building", centre, half, top)
        for _ in range(self.rng.integers(1, 4)):
            size = np.minimum(self.rng.uniform(0.35, 0.8, 2), half / 3)
            place = centre + self.rng.uniform(-1, 1, 2) * (half - size - 0.5)
            self.box("plant", place, size, top + self.rng.uniform(0.4, 0.9))

    def park(self, centre: NDArray[np.float64]) -> None:
        placed: list[NDArray[np.float64]] = []
        while len(placed) < 16:
            place = self.rng.uniform(-INNER + 0.8, INNER - 0.8, 2)
            ring = abs(np.linalg.norm(place) - 0.55 * INNER)  # no trees on the path
            if ring > 1.1 and all(np.linalg.norm(place - other) > 1.5 for other in placed):
                placed.append(place)
                self.tree(centre + place)

    def pavement_trees(self, centre: NDArray[np.float64]) -> None:
        for turn in range(4):
            along = np.array([np.cos(turn * np.pi / 2), np.sin(turn * np.pi / 2)])
            across = np.array([-along[1], along[0]])
            for step in (-0.75, -0.25, 0.25, 0.75):
                if self.rng.random() < 0.6:
                    place = along * step * INNER + across * (INNER + 0.7 * PAVEMENT)
                    self.tree(centre + place, size=0.7)

    def outskirts(self, blocks: tuple[int, int]) -> None:
        """Scattered trees in the fields around, two for each block along the border."""
        reach = np.array(blocks) * BLOCK_WIDTH / 2
        for axis in (0, 1):
            for side in (-1, 1):
                for _ in range(2 * blocks[1 - axis]):
                    place = self.rng.uniform(-1, 1, 2) * reach
                    place[axis] = side * (reach[axis] + self.rng.uniform(5.5, 14.0))
                    self.tree(place, size=1.2)

    def tree(self, place: NDArray[np.float64], size: float = 1.0) -> None:
        """A trunk and a crown of a few overlapping spheres."""
        radius = size * self.rng.uniform(0.75, 1.25)
        height = radius * self.rng.uniform(1.6, 2.1)
        self.box("trunk", place, np.full(2, 0.16 * radius), height)
        self.spheres.append([*place, height + 0.3 * radius, radius * 0.85])
        angle = self.rng.uniform(0, 2 * np.pi)
        for turn in range(4):
            out = angle + turn * np.pi / 2 + self.rng.uniform(-0.4, 0.4)
            offset = radius * 0.55 * np.array([np.cos(out), np.sin(out)])
            self.spheres.append(
                [*(place + offset), height + self.rng.uniform(-0.2, 0.2) * radius, radius * self.rng.uniform(0.5, 0.65)]
            )

    def cars(self, axis: int, line: float, reach: float) -> None:
        """Parked cars on both sides of the street along the other axis at coordinate `line`."""
        for side in (-1, 1):
            for place in np.arange(-reach + 6.5, reach - 5.0, 2.6):
                if abs((place + reach + BLOCK_WIDTH / 2) % BLOCK_WIDTH - BLOCK_WIDTH / 2) < 5.5:
                    continue  # no cars on the crossings
                if self.rng.random() < 0.35:
                    centre, half = np.empty(2), np.empty(2)
                    centre[axis], centre[1 - axis] = line + side * (STREET - 0.6), place
                    half[axis], half[1 - axis] = 0.4, 0.95
                    self.box("car", centre, half, 0.38)
                    self.box("cabin", centre, half * (0.9, 0.9) - 0.28 * (half > 0.5), 0.66)

    def roof_parts(self) -> None:
        """Vents, chimneys and skylights on every roof, and rows of panels on some."""
        roofs = [box for box, kind in zip(self.boxes, self.kinds) if kind == "building"]
        for low, high in np.array(roofs):
            centre, half = (low[:2] + high[:2]) / 2, (high[:2] - low[:2]) / 2
            for _ in range(self.rng.poisson(0.4 * 4 * half.prod())):
                size = self.rng.uniform(0.05, 0.2, 2)
                place = centre + self.rng.uniform(-1, 1, 2) * (half - size - 0.35)
                self.box("part", place, size, high[2] + self.rng.uniform(0.06, 0.45))
            if self.rng.random() < 0.3:
                first = centre - half * self.rng.uniform(0.3, 0.8, 2)
                for row, column in np.ndindex(*self.rng.integers(2, 5, 2)):
                    place = first + (0.52 * column, 0.42 * row)
                    if (np.abs(place - centre) < half - 0.6).all():
                        self.box("part", place, np.array([0.23, 0.14]), high[2] + 0.09)

    def street_parts(self, centre: NDArray[np.float64]) -> None:
        """Lamps along the pavement, and benches, bins and bushes in a block."""
        for side in np.ndindex(2, 2, 3):
            across = (2 * side[1] - 1) * (INNER + 0.6 * PAVEMENT)
            place = np.array([across, (side[2] - 1) * 0.9 * INNER])
            place = centre + (place if side[0] else place[::-1])
            self.box("part", place, np.full(2, 0.035), self.rng.uniform(1.1, 1.3))
        for _ in range(14):
            place = centre + self.rng.uniform(-0.95, 0.95, 2) * INNER
            self.box("part", place, self.rng.uniform(0.06, 0.25, 2), self.rng.uniform(0.1, 0.3))
        for _ in range(10):
            radius = self.rng.uniform(0.12, 0.4)
            self.spheres.append([*(centre + self.rng.uniform(-0.95, 0.95, 2) * INNER), 0.5 * radius, radius])


def sample(city: City, count: int, margin: float, rng: np.random.Generator) -> NDArray[np.float64]:
    """The points of `sample_solids` alone."""
    return sample_solids(city, count, margin, rng)[0]


def sample_solids(
    city: City, count: int, margin: float, rng: np.random.Generator
) -> tuple[NDArray[np.float64], NDArray[np.integer]]:
    """Sample points uniformly from the area of all surfaces, of ground that reaches by `margin`,
    world units, beyond the built area.

    Parts of surfaces inside another solid are included, since the ray caster tells what is visible.
    Returns the points [count, 3], world, and their primitives [count]: 0 for the ground, then the
    boxes, then the spheres.
    """
    size = city.boxes[:, 1] - city.boxes[:, 0]
    ground = city.extent + margin
    faces = (
        np.stack([size[:, 1] * size[:, 2], size[:, 0] * size[:, 2], size[:, 0] * size[:, 1] / 2], axis=1) * 2
    )  # x sides, y sides, the top
    areas = np.concatenate([[4 * ground.prod()], faces.ravel(), 4 * np.pi * city.spheres[:, 3] ** 2])
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
    solid = np.where(on, chosen - faces.size + len(city.boxes), (chosen + 2) // 3)
    return points, solid


def geometry_json(city: City, gains: NDArray[np.float64] | None = None) -> str:
    """The text of `geometry.json`, the ground truth of a scene folder. By the `gains` [V, 3] the
    light of each photo was multiplied; None: they are all one."""
    table = {
        "about": "ground truth: ground plane z = 0, boxes standing on it, spheres; z is up",
        "unit_metres": UNIT_METRES,
        "seed": city.seed,
        "blocks": list(city.blocks),
        "ground_extent": [(-city.extent).tolist(), city.extent.tolist()],
        "parks": city.parks.astype(int).tolist(),
        "boxes": [
            {"kind": KINDS[kind], "low": low.tolist(), "high": high.tolist()}
            for kind, (low, high) in zip(city.kinds, city.boxes)
        ],
        "spheres": [{"centre": row[:3].tolist(), "radius": row[3]} for row in city.spheres],
        **({} if gains is None else {"gains": gains.tolist()}),
    }
    rows = json.dumps(table).replace('{"kind"', '\n{"kind"').replace('{"centre"', '\n{"centre"')
    return rows + "\n"


def read_city(path: Path) -> City:
    """The city of a `geometry.json`."""
    table = json.loads(path.read_text("utf-8"))
    return City(
        table["seed"],
        tuple(table["blocks"]),
        np.array(table["parks"], bool),
        np.array([[box["low"], box["high"]] for box in table["boxes"]]),
        np.array([KINDS.index(box["kind"]) for box in table["boxes"]]),
        np.array([[*ball["centre"], ball["radius"]] for ball in table["spheres"]]).reshape(-1, 4),
    )


def from_above(
    city: City, x: NDArray[np.float64], y: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.integer]]:
    """Heights of the surface at places [...], as seen from straight above, and the solids seen
    there: 0 for the ground, then the boxes, then the spheres."""
    heights, solids = np.zeros(x.shape), np.zeros(x.shape, int)
    for number, solid in enumerate([*city.boxes, *city.spheres], 1):
        if solid.ndim == 2:
            inside = (solid[0, 0] <= x) & (x <= solid[1, 0]) & (solid[0, 1] <= y) & (y <= solid[1, 1])
            tops = np.where(inside, solid[1, 2], 0)
        else:
            beneath = solid[3] ** 2 - (x - solid[0]) ** 2 - (y - solid[1]) ** 2
            tops = np.where(beneath > 0, solid[2] + np.sqrt(np.maximum(beneath, 0)), 0)
        solids[tops > heights] = number
        np.maximum(heights, tops, out=heights)
    return heights, solids


def distances(city: City, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """How far points [N, 3] are from the visible surface of a city, world units, below zero inside
    of solids or ground, where it is at least so far."""
    nearest = points[:, 2].copy()
    for low, high in city.boxes:
        beyond = np.maximum(low - points, points - high)
        np.minimum(
            nearest, np.linalg.norm(np.maximum(beyond, 0), axis=1) + np.minimum(beyond.max(axis=1), 0), out=nearest
        )
    for *centre, radius in city.spheres:
        np.minimum(nearest, np.linalg.norm(points - centre, axis=1) - radius, out=nearest)
    return nearest
