"""The part of a scene that a block owns: a cell of a box-like space, and a margin around it."""

from dataclasses import dataclass, field

import numpy as np

ORTHONORMAL = 1e-6  # how far a rotation read from a file may be from one
Z = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True, eq=False)
class Space:
    """Coordinates in which cells are boxes.

    rotation: float64[3, 3], rows are the axes u, v (along the ground) and up, world frame; origin:
    float64[3] and half: float64[3], centre and half sides of the area of interest, world units:
    it has coordinates from -1 to 1. contracted: all of the world is put into [0, 1]^3 instead, the
    area into [1/4, 3/4]^3, by the inf-norm contraction (Liu et al. 2024, CityGaussian, eq. 2).
    Raises ValueError for what is no such space.
    """

    rotation: np.ndarray
    origin: np.ndarray
    half: np.ndarray
    contracted: bool = False

    def __post_init__(self):
        for name, shape in (("rotation", (3, 3)), ("origin", (3,)), ("half", (3,))):
            values = np.array(getattr(self, name), np.float64)
            if values.shape != shape or not np.isfinite(values).all():
                raise ValueError(f"{name} is not {'x'.join(map(str, shape))} finite numbers")
            object.__setattr__(self, name, values)
        if (np.abs(self.rotation @ self.rotation.T - np.eye(3)) > ORTHONORMAL).any():
            raise ValueError("rotation is not an orthonormal 3 x 3 matrix")
        if not (self.half > 0).all():
            raise ValueError("half has a side of no length")

    @property
    def bounds(self):
        """(low, high): the coordinates between which every cell has a finite side."""
        return (0.0, 1.0) if self.contracted else (-1.0, 1.0)

    def to(self, points):
        """Coordinates float64[N, 3] of world points [N, 3]; nan where a point is not finite."""
        with np.errstate(invalid="ignore", over="ignore", divide="ignore"):
            u = (np.asarray(points, np.float64) - self.origin) @ self.rotation.T / self.half
            if not self.contracted:
                return np.where(np.isfinite(u), u, np.nan)
            largest = np.maximum(np.abs(u).max(axis=1, keepdims=True), 1)
            return (2 - 1 / largest) * (u / largest) / 4 + 0.5

    def world(self, coordinates):
        """World points float64[N, 3] of coordinates [N, 3]; contracted ones lie within (0, 1)."""
        u = np.asarray(coordinates, np.float64)
        if self.contracted:
            u = 4 * u - 2
            largest = np.maximum(np.abs(u).max(axis=1, keepdims=True), 1)
            u = u / largest / (2 - largest)
        return self.origin + u * self.half @ self.rotation

    def map(self, points):
        """float64[N, 2]: where world points [N, 3] lie on a map. It has the world's x and y where z
        is up, else those of the world turned by the least angle that makes it so."""
        return np.asarray(points, np.float64) @ map_axes(self.rotation[2]).T

    def record(self):
        """A dict for JSON."""
        return {"rotation": self.rotation.tolist(), "origin": self.origin.tolist(),
                "half": self.half.tolist(), "contracted": self.contracted}

    @classmethod
    def from_record(cls, record):
        """The Space of a `record`; ValueError for anything else."""
        try:
            return cls(**{key: record[key] for key in ("rotation", "origin", "half")},
                       contracted=bool(record["contracted"]))
        except (KeyError, TypeError, OverflowError) as error:
            raise ValueError(f"no record of a space ({error})") from None


def map_axes(up):
    """float64[2, 3]: the map's x and y in the world, where `up` (a unit float64[3]) is up."""
    halfway = up + Z
    square = halfway @ halfway
    if square < 1e-24:  # the world stands on its head: turn it about x
        return np.array([[1.0, 0, 0], [0, -1, 0]])
    # the least turn of up to z, as two mirrorings
    return (np.eye(3) - 2 / square * np.outer(halfway, halfway) + 2 * np.outer(Z, up))[:2]


@dataclass(frozen=True, eq=False)
class Region:
    """A cell [low, high) of a Space, float64[3] each, ends may be -inf and inf; margin: by how much
    of its sides a block trains beyond them. Raises ValueError for what is no cell."""

    space: Space
    low: np.ndarray = field(default_factory=lambda: np.full(3, -np.inf))
    high: np.ndarray = field(default_factory=lambda: np.full(3, np.inf))
    margin: float = 0.0

    def __post_init__(self):
        for name in ("low", "high"):
            object.__setattr__(self, name, np.array(getattr(self, name), np.float64))
        if not (self.low.shape == self.high.shape == (3,) and (self.low < self.high).all()):
            raise ValueError("a cell's low is not below its high, three numbers each")
        if not 0 <= self.margin < np.inf:
            raise ValueError(f"a margin of {self.margin}")

    @property
    def side(self):
        """float64[3]: sides of the cell in its space; endless ones are cut at the space's bounds.
        """
        low, high = self.space.bounds
        return np.maximum(np.where(np.isinf(self.high), high, self.high)
                          - np.where(np.isinf(self.low), low, self.low), 0)

    def grown(self, margin):
        """The Region `margin` of its sides larger in every direction, without a margin itself."""
        return Region(self.space, self.low - margin * self.side, self.high + margin * self.side)

    def cut(self, axis, at):
        """(lower, upper): the two Regions on either side of coordinate `at` along an axis."""
        low, high = self.low.copy(), self.high.copy()
        low[axis] = high[axis] = at
        return (Region(self.space, self.low, high, self.margin),
                Region(self.space, low, self.high, self.margin))

    def owns(self, points):
        """bool[N]: which world points [N, 3] the cell holds. None that is not finite."""
        return self.holds(self.space.to(points))

    def reaches(self, points, spread=0.0):
        """bool[N]: which world points [N, 3] the cell holds when grown by its margin, and with them
        what lies `spread` float[N] world units from them along u and v."""
        grown, points = self.grown(self.margin), np.asarray(points, np.float64)
        reached = grown.owns(points)
        spread = np.broadcast_to(spread, len(points))
        for step in (*self.space.rotation[:2], *-self.space.rotation[:2]):
            wide = np.flatnonzero(reached & (spread > 0))
            reached[wide] = grown.owns(points[wide] + spread[wide, None] * step)
        return reached

    def holds(self, coordinates):
        """bool[N]: as `owns`, of coordinates in the space."""
        return ((coordinates >= self.low) & (coordinates < self.high)).all(axis=1)

    def record(self):
        """A dict for JSON; null stands for an end that is not there."""
        low, high = ([x if np.isfinite(x) else None for x in ends.tolist()]
                     for ends in (self.low, self.high))
        return {"space": self.space.record(), "low": low, "high": high, "margin": self.margin}

    @classmethod
    def from_record(cls, record):
        """The Region of a `record`; ValueError for anything else."""
        try:
            low, high = (np.array([end if x is None else float(x) for x in record[key]])
                         for key, end in (("low", -np.inf), ("high", np.inf)))
            return cls(Space.from_record(record["space"]), low, high, float(record["margin"]))
        except (KeyError, TypeError, OverflowError) as error:
            raise ValueError(f"no record of a region ({error})") from None
