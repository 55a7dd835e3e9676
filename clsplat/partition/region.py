"""Cells of a box-like space, which blocks own, and the partition of a scene into such cells."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clsplat.camera import turned
from clsplat.scene import Scene

CONTENT_QUANTILES = (0.01, 0.99)  # content beyond these counts as outliers
ANGLE_STEPS = 90  # rectangles that are tried over a quarter turn
MOST_TRIED = 50_000  # content points that the rectangles are tried on
RECTANGLE_QUANTILES = (0.002, 0.998)  # inside the rectangle; with fewer, corners would be cut off
ROTATION_TOLERANCE = 1e-6  # largest element of R R^T - I in a rotation that is read from a file
MOST_RANKED = 1_000_000  # values whose quantiles are sought
PART_ROWS = 1 << 16  # that a thread takes at a time: what it makes of them stays in its cache
Z = np.array([0.0, 0.0, 1.0])
# what a record that is damaged raises
DAMAGED = (ValueError, KeyError, TypeError, AttributeError, OverflowError)


@dataclass(frozen=True, eq=False)
class Space:
    """Coordinates in which cells are boxes; the area of interest has coordinates from -1 to 1.
    ValueError for numbers that do not describe such a space.

    Attributes
    ----------
    rotation : [3, 3], world frame; its rows are the axes u, v (along the ground) and up.
    origin, half : [3], world units; the centre of the area of interest, and half its sides.
    contracted : the whole world lies in [0, 1]^3 instead, and the area of interest in
        [1/4, 3/4]^3, by the inf-norm contraction (Liu et al. 2024, CityGaussian, eq. 2).
    """

    rotation: NDArray[np.float64]
    origin: NDArray[np.float64]
    half: NDArray[np.float64]
    contracted: bool = False

    def __post_init__(self) -> None:
        for name in ("rotation", "origin", "half"):
            object.__setattr__(self, name, np.array(getattr(self, name), np.float64))
        if (
            (self.rotation.shape, self.origin.shape, self.half.shape) != ((3, 3), (3,), (3,))
            or not np.allclose(self.rotation @ self.rotation.T, np.eye(3), 0, ROTATION_TOLERANCE)
            or not (np.isfinite([self.origin, self.half]) & (self.half > 0)).all()
        ):
            raise ValueError("a space needs an orthonormal rotation, a finite origin and three positive half sides")

    def to(self, points: ArrayLike) -> NDArray[np.float64]:
        """Coordinates [N, 3] of world points [N, 3]; nan where a point is not finite."""
        with np.errstate(invalid="ignore", over="ignore", divide="ignore"):
            u = turned(self.rotation, np.asarray(points, np.float64) - self.origin)
            u /= self.half[:, None]
            if self.contracted:
                largest = np.maximum(np.maximum.reduce(np.abs(u)), 1)
                u *= (2 - 1 / largest) / largest / 4
                u += 0.5
            else:
                u[~np.isfinite(u)] = np.nan
            return u.T

    @property
    def most_change(self) -> float:
        """By how much a step of one world unit changes a coordinate at most, and a hair more.

        The contraction g(L) u, g = (2 - 1 / L) / L, changes by at most g + L |g'| = 4 / L - 3 / L^2
        <= 4/3 where u does by 1, and contracted coordinates are a quarter of that."""
        return float((0.334 if self.contracted else 1.001) / self.half.min())

    def world(self, coordinates: ArrayLike) -> NDArray[np.float64]:
        """World points [N, 3] of coordinates [N, 3]; contracted ones lie within (0, 1)."""
        u = np.asarray(coordinates, np.float64)
        if self.contracted:
            u = 4 * u - 2
            largest = np.maximum(np.abs(u).max(axis=1, keepdims=True), 1)
            u = u / largest / (2 - largest)
        return self.origin + u * self.half @ self.rotation

    def map(self, points: ArrayLike) -> NDArray[np.float64]:
        """Map coordinates [N, 2], world units, of world points [N, 3].

        Where z is up, these are the world's x and y. Otherwise the world is first rotated by the
        smallest angle that turns `up` to z.
        """
        return np.asarray(points, np.float64) @ map_axes(self.rotation[2]).T

    def record(self) -> dict[str, Any]:
        """The space as a dict for JSON."""
        return {
            "rotation": self.rotation.tolist(),
            "origin": self.origin.tolist(),
            "half": self.half.tolist(),
            "contracted": self.contracted,
        }

    @classmethod
    def from_record(cls, record: Any) -> Space:
        """The Space that `record` described; one of DAMAGED for anything else."""
        return cls(
            **{key: record[key] for key in ("rotation", "origin", "half")}, contracted=bool(record["contracted"])
        )


def map_axes(up: NDArray[np.float64]) -> NDArray[np.float64]:
    """The map's x and y axes [2, 3] in the world frame, for a unit vector `up` [3]."""
    halfway = up + Z
    square = halfway @ halfway
    if square < 1e-24:  # up is -z: rotate half a turn about x
        return np.array([[1.0, 0, 0], [0, -1, 0]])
    # the smallest rotation of up to z, as two reflections
    rotation: NDArray[np.float64] = np.eye(3) - 2 / square * np.outer(halfway, halfway) + 2 * np.outer(Z, up)
    return rotation[:2]


def ground_axes(
    up: NDArray[np.float64], content: NDArray[np.float64], weights: NDArray[np.float64]
) -> NDArray[np.float64]:
    """The axes u, v and up as rows [3, 3], right-handed, with u along the content's longer side.

    u and v are the sides of the smallest rectangle around the content [M, 3], without outliers and
    what has weight 0, which follows streets and flight lines; u points to the side where the
    content has its longer tail. The axes therefore rotate with the scene."""
    first = np.cross(up, np.eye(3)[np.abs(up).argmin()])
    plane = np.stack([first, np.cross(up, first)]) / np.linalg.norm(first)
    content, weights = content[weights > 0], weights[weights > 0]
    sampled = content[:: -(-len(content) // MOST_TRIED)]
    along = (sampled - sampled.mean(axis=0)) @ plane.T
    principal = np.linalg.eigh(along.T @ along)[1][:, 1]
    angles = np.arctan2(principal[1], principal[0]) + np.arange(ANGLE_STEPS) / ANGLE_STEPS * np.pi / 2
    areas = [
        np.prod(np.ptp(np.quantile(along @ _rotation(angle).T, RECTANGLE_QUANTILES, axis=0), axis=0))
        for angle in angles
    ]
    axes = _rotation(angles[np.argmin(areas)]) @ plane
    low, middle, high = np.transpose([quantiles(content @ axis, weights, (0.01, 0.5, 0.99)) for axis in axes])
    longer = int(np.argmax(high - low))
    u = axes[longer] * (1 if high[longer] + low[longer] >= 2 * middle[longer] else -1)
    return np.stack([u, np.cross(up, u), up])


def _rotation(angle: float) -> NDArray[np.float64]:
    return np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])


def quantiles(
    values: NDArray[np.float64], weights: NDArray[np.float64], shares: Sequence[float]
) -> NDArray[np.float64]:
    """Weighted quantiles [K]: the numbers below which `shares` [K] of the weight of `values` lie,
    or where they are many, of every k-th of them."""
    some = slice(None, None, max(1, len(values) // MOST_RANKED))
    values, weights = values[some], weights[some]
    order = np.argsort(values, kind="stable")
    weight = np.cumsum(weights[order])
    return np.interp(shares, (weight - weights[order] / 2) / weight[-1], values[order])


def world_of(scene: Scene, points: ArrayLike) -> NDArray[np.float64]:
    """The original world coordinates [N, 3] of points in the local frame of a scene."""
    return scene.offset + scene.unit * np.asarray(points, np.float64).reshape(-1, 3)


def in_parts(function: Callable[..., NDArray[Any]], *rows: NDArray[Any], size: int = PART_ROWS) -> NDArray[Any]:
    """What a function of rows [N, ...] returns for each row, [N]; it is called with `size` of them
    at a time, in threads: on two cores, that finds which of 4 M rows a block trains in half of the
    time."""
    firsts = range(0, max(1, len(rows[0])), size)
    if len(firsts) == 1:
        return function(*rows)
    with ThreadPoolExecutor() as threads:
        return np.concatenate(
            [*threads.map(lambda first: function(*(each[first : first + size] for each in rows)), firsts)]
        )


@dataclass(frozen=True, eq=False)
class Region:
    """A cell of a Space, which one block owns; ValueError for numbers that do not describe one.

    Attributes
    ----------
    space : the coordinates that `low` and `high` are in.
    low, high : [3]; the cell begins at `low`, and ends below `high`. -inf and inf: unbounded.
    margin : share of each side by which a block trains beyond its cell.
    """

    space: Space
    low: NDArray[np.float64] = field(default_factory=lambda: np.full(3, -np.inf))
    high: NDArray[np.float64] = field(default_factory=lambda: np.full(3, np.inf))
    margin: float = 0.0

    def __post_init__(self) -> None:
        for name in ("low", "high"):
            object.__setattr__(self, name, np.array(getattr(self, name), np.float64))
        if not (
            self.low.shape == self.high.shape == (3,) and (self.low < self.high).all() and 0 <= self.margin < np.inf
        ):
            raise ValueError(
                "a cell needs three numbers low below three numbers high, and a finite margin of at least 0"
            )

    @property
    def side(self) -> NDArray[np.float64]:
        """Sides [3] of the cell in its space; unbounded ones are cut where the area of interest
        ends, or contracted space."""
        low, high = (0.0, 1.0) if self.space.contracted else (-1.0, 1.0)
        side: NDArray[np.float64] = np.maximum(
            np.where(np.isinf(self.high), high, self.high) - np.where(np.isinf(self.low), low, self.low), 0
        )
        return side

    def grown(self, margin: float) -> Region:
        """The Region enlarged by this share of its sides in every direction, without a margin."""
        return Region(self.space, self.low - margin * self.side, self.high + margin * self.side)

    def cut(self, axis: int, at: float) -> tuple[Region, Region]:
        """The two Regions below and above the coordinate `at` along an axis."""
        low, high = self.low.copy(), self.high.copy()
        low[axis] = high[axis] = at
        return (Region(self.space, self.low, high, self.margin), Region(self.space, low, self.high, self.margin))

    def owns(self, points: ArrayLike) -> NDArray[np.bool_]:
        """Which world points [N, 3] lie in the cell, as bool[N]; False for those not finite."""
        return self.holds(self.space.to(points))

    def reaches(self, points: ArrayLike, spread: ArrayLike = 0.0) -> NDArray[np.bool_]:
        """Which world points [N, 3] lie in the cell enlarged by its margin, as bool[N].

        `spread` : [N] or one number, world units; points at this distance along u and v must lie in
        the enlarged cell too."""
        grown, points = self.grown(self.margin), np.asarray(points, np.float64)
        coordinates = self.space.to(points)
        reached = grown.holds(coordinates)
        spread = np.broadcast_to(spread, len(points))
        # the others are so far inside that no step of their spread leads out
        inside = np.minimum.reduce(np.minimum(coordinates - grown.low, grown.high - coordinates).T)
        near = np.flatnonzero(reached & (spread > 0) & ~(inside > spread * self.space.most_change))
        for step in (*self.space.rotation[:2], *-self.space.rotation[:2]):
            wide = near[reached[near]]
            reached[wide] = grown.owns(points[wide] + spread[wide, None] * step)
        return reached

    def holds(self, coordinates: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Which coordinates [N, 3] of the space lie in the cell, as bool[N]."""
        u, v, up = ((coordinates >= self.low) & (coordinates < self.high)).T
        inside: NDArray[np.bool_] = u & v & up  # ten times as fast as np.all along rows
        return inside

    def record(self) -> dict[str, Any]:
        """The region as a dict for JSON; null stands for an unbounded end."""
        low, high = ([x if np.isfinite(x) else None for x in ends.tolist()] for ends in (self.low, self.high))
        return {"space": self.space.record(), "low": low, "high": high, "margin": self.margin}

    @classmethod
    def from_record(cls, record: Any) -> Region:
        """The Region that `record` described; one of DAMAGED for anything else."""
        low, high = (
            np.array([end if x is None else float(x) for x in record[key]])
            for key, end in (("low", -np.inf), ("high", np.inf))
        )
        return cls(Space.from_record(record["space"]), low, high, float(record["margin"]))


class Cells:
    """A table of which of many Regions of one space contains a point; ValueError if two overlap.

    Attributes
    ----------
    edges : along each axis the ends of the cells, ascending.
    table : [edges + 1 along each axis]; the index of the cell between two edges, -1 for none.
    """

    def __init__(self, regions: Sequence[Region]) -> None:
        low, high = (np.array([getattr(region, name) for region in regions]) for name in ("low", "high"))
        self.edges = [np.unique(ends[np.isfinite(ends)]) for ends in np.concatenate([low, high]).T]
        first = [np.searchsorted(e, ends, side="right") for e, ends in zip(self.edges, low.T)]
        end = [np.searchsorted(e, ends, side="left") + 1 for e, ends in zip(self.edges, high.T)]
        self.table = np.full([len(e) + 1 for e in self.edges], -1, np.int32)
        for cell, ranges in enumerate(zip(*map(zip, first, end))):
            part = self.table[tuple(slice(*ends) for ends in ranges)]
            if (part >= 0).any():
                raise ValueError(f"blocks {part.max()} and {cell} overlap")
            part[...] = cell

    def at(self, coordinates: NDArray[np.float64]) -> NDArray[np.integer]:
        """The cell [N] at coordinates [N, 3] of the space; -1 where they are not finite."""
        place = tuple(np.searchsorted(e, column, side="right") for e, column in zip(self.edges, coordinates.T))
        return np.where(np.isfinite(coordinates).all(axis=1), self.table[place], -1)


@dataclass(frozen=True, eq=False)
class Partition:
    """Which block owns which part of the world, and which views each block trains on; ValueError
    for cells that overlap or leave gaps.

    Attributes
    ----------
    method : the name of the method that made it.
    regions : the cell of each block.
    views : [K] for each block; indices into scene.views, ascending.
    dropped : for each view that no block is assigned, by its index, the reason.
    """

    method: str
    regions: tuple[Region, ...]
    views: tuple[NDArray[np.integer], ...]
    dropped: dict[int, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not self.regions or len(self.regions) != len(self.views):
            raise ValueError(f"{len(self.regions)} regions and {len(self.views)} lists of views")
        if (self.cells.table < 0).any():
            raise ValueError("the blocks leave a gap")

    def check_views(self, count: int) -> None:
        """Raise ValueError for an index of a view that is not below `count`."""
        for index in (*self.dropped, *(int(i) for views in self.views for i in views)):
            if not 0 <= index < count:
                raise ValueError(f"view {index} of {count}")

    @property
    def space(self) -> Space:
        """The space of all cells."""
        return self.regions[0].space

    @cached_property
    def cells(self) -> Cells:
        """The table of the blocks' cells."""
        return Cells(self.regions)

    def owner(self, points: ArrayLike) -> NDArray[np.integer]:
        """The block [N] that owns each world point [N, 3]; -1 for points that are not finite."""
        cells, space = self.cells, self.space
        return in_parts(lambda some: cells.at(space.to(some)), np.asarray(points))

    def record(self) -> dict[str, Any]:
        """The partition as a dict for JSON."""
        return {
            "method": self.method,
            "space": self.space.record(),
            "regions": [
                {key: value for key, value in region.record().items() if key != "space"} for region in self.regions
            ],
            "views": [views.tolist() for views in self.views],
            "dropped": {str(view): why for view, why in self.dropped.items()},
        }

    @classmethod
    def from_record(cls, record: Any) -> Partition:
        """The Partition that `record` described; one of DAMAGED for anything else."""
        regions = tuple(Region.from_record({**region, "space": record["space"]}) for region in record["regions"])
        return cls(
            str(record["method"]),
            regions,
            tuple(np.array(views, int).reshape(-1) for views in record["views"]),
            {int(view): str(why) for view, why in record["dropped"].items()},
        )
