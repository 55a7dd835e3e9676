"""Colours of the city's surfaces as functions of the surface point: the same from every view.

Edges are ramps of EDGE_WIDTH and the finest noise has cells of 0.4 units, so that no detail is
smaller than a pixel of the default survey (about 0.13 units).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tools.synth.city import BLOCK_WIDTH, KINDS, PAVEMENT, STREET, City

EDGE_WIDTH = 0.12  # world units
LATTICE = 32  # cells after which the noise repeats
FACADES = np.array([[0.80, 0.68, 0.50], [0.68, 0.36, 0.27], [0.82, 0.79, 0.73], [0.58, 0.54, 0.50],
                    [0.88, 0.72, 0.42], [0.48, 0.58, 0.66], [0.80, 0.56, 0.45], [0.56, 0.65, 0.50]])
ROOFS = np.array([[0.58, 0.57, 0.55], [0.62, 0.36, 0.27], [0.46, 0.47, 0.50], [0.70, 0.67, 0.60],
                  [0.40, 0.50, 0.38]])
CARS = np.array([[0.80, 0.80, 0.80], [0.20, 0.22, 0.25], [0.70, 0.15, 0.13], [0.18, 0.32, 0.60],
                 [0.55, 0.56, 0.58], [0.85, 0.70, 0.20]])


def _below(value: NDArray[np.float64], edge: float | NDArray[np.float64]
           ) -> NDArray[np.float64]:
    """1 where value < edge and 0 where it is larger, with a ramp of EDGE_WIDTH."""
    return np.clip((edge - value) / EDGE_WIDTH + 0.5, 0, 1)


def _mix(first: NDArray[np.float64], second: ArrayLike, weight: NDArray[np.float64]
         ) -> NDArray[np.float64]:
    """Linear interpolation from `first` to `second`."""
    return first + (np.asarray(second) - first) * weight[:, None]


def _stripes(value: NDArray[np.float64], period: float, share: float) -> NDArray[np.float64]:
    """1 on stripes that fill `share` of each `period`, with soft edges."""
    off_centre = np.abs((value / period) % 1 - 0.5) * period
    return _below(off_centre, share * period / 2)


def _to_street(coordinate: NDArray[np.float64], count: int) -> NDArray[np.float64]:
    """Signed distance to the nearest of the count + 1 street centre lines."""
    line = np.clip(np.round(coordinate / BLOCK_WIDTH + count / 2), 0, count)
    return coordinate - (line - count / 2) * BLOCK_WIDTH


class Texture:
    """The colours of one city; `albedo` is a pure function of the surface point."""

    def __init__(self, city: City) -> None:
        rng = np.random.default_rng([city.seed, 2])
        count = len(city.boxes)
        self.city = city
        self.lattice = rng.random((LATTICE,) * 3)
        # in turn, so that neighbouring buildings differ
        turn = np.cumsum(city.kinds == KINDS.index("building")) + rng.integers(0, 40)
        self.facades = FACADES[3 * turn % len(FACADES)] * rng.uniform(0.85, 1.1, (count, 1))
        self.roofs = ROOFS[2 * turn % len(ROOFS)] * rng.uniform(0.85, 1.1, (count, 1))
        self.cars = CARS[rng.integers(0, len(CARS), count)]
        self.bays = rng.uniform(1.0, 1.6, count)  # approximate distance between windows
        self.storeys = rng.uniform(1.0, 1.4, count)
        self.window_share = rng.uniform(0.45, 0.65, (count, 2))

    def noise(self, points: NDArray[np.float64], scale: float) -> NDArray[np.float64]:
        """Value noise [N], 0 to 1, with cells of `scale` world units (Perlin's cubic fade)."""
        cell = points / scale
        low = np.floor(cell)
        fade = cell - low
        fade = fade * fade * (3 - 2 * fade)
        low = low.astype(np.int64) % LATTICE
        high = (low + 1) % LATTICE
        x, y, z = fade.T
        value = np.zeros(len(points))
        for ix, wx in ((low[:, 0], 1 - x), (high[:, 0], x)):
            for iy, wy in ((low[:, 1], 1 - y), (high[:, 1], y)):
                for iz, wz in ((low[:, 2], 1 - z), (high[:, 2], z)):
                    value = value + wx * wy * wz * self.lattice[ix, iy, iz]
        return value

    def albedo(self, primitive: NDArray[np.integer], points: NDArray[np.float64],
               normals: NDArray[np.float64]) -> NDArray[np.float64]:
        """Colours [N, 3], 0 to 1, of surface points.

        Parameters
        ----------
        primitive : [N]; 0 for the ground, then boxes, then spheres.
        points : [N, 3], world.
        normals : [N, 3], world.
        """
        colour = np.empty_like(points)
        boxes = len(self.city.boxes)
        on = primitive == 0
        colour[on] = self._ground(points[on])
        on = primitive > boxes
        colour[on] = self._leaves(points[on])
        kind = np.full(len(points), -1)
        on = (primitive > 0) & (primitive <= boxes)
        kind[on] = self.city.kinds[primitive[on] - 1]
        for name, paint in (("building", self._building), ("plant", self._plant),
                            ("car", self._car), ("cabin", self._cabin), ("trunk", self._trunk)):
            on = kind == KINDS.index(name)
            if on.any():
                colour[on] = paint(primitive[on] - 1, points[on], normals[on])
        return np.clip(colour, 0, 1)

    def _ground(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        city = self.city
        reach = np.array(city.blocks) * BLOCK_WIDTH / 2
        coarse, middle, fine = (self.noise(points, scale) for scale in (7.0, 1.7, 0.5))
        x, y = points[:, 0], points[:, 1]
        u, v = _to_street(x, city.blocks[0]), _to_street(y, city.blocks[1])
        built = np.maximum(np.abs(x) - reach[0], np.abs(y) - reach[1])  # < 0 inside the ring road

        lawn = _mix(np.array([0.36, 0.45, 0.22]), [0.55, 0.52, 0.30], coarse)
        lawn = lawn * (0.8 + 0.25 * middle + 0.15 * fine)[:, None]
        yard = np.array([0.60, 0.57, 0.52]) * (0.82 + 0.18 * middle + 0.12 * fine)[:, None]
        joints = np.maximum(_stripes(x, 1.5, 0.1), _stripes(y, 1.5, 0.1))
        yard = yard * (1 - 0.15 * joints)[:, None]
        place = np.stack([x, y]) / BLOCK_WIDTH + np.array(city.blocks)[:, None] / 2
        block = np.clip(np.floor(place).astype(int), 0, np.array(city.blocks)[:, None] - 1)
        path = np.hypot(*((place - block - 0.5) * BLOCK_WIDTH))
        path = _below(np.abs(path - 0.55 * (BLOCK_WIDTH / 2 - STREET - PAVEMENT)), 0.6)
        park = _mix(lawn, [0.72, 0.65, 0.50], path)
        inside = np.where(city.parks[tuple(block)][:, None], park, yard)
        colour = _mix(lawn, inside, _below(built, 0))

        near = np.minimum(np.abs(u), np.abs(v))
        outer = _below(built, STREET + PAVEMENT)
        pavement = np.array([0.66, 0.65, 0.63]) * (0.88 + 0.2 * middle)[:, None]
        colour = _mix(colour, pavement, _below(near, STREET + PAVEMENT) * outer)
        asphalt = np.array([0.33, 0.34, 0.36]) * (0.8 + 0.2 * middle + 0.2 * fine)[:, None]
        road = _below(near, STREET) * _below(built, STREET)
        colour = _mix(colour, asphalt, road)
        for across, along, line in ((u, v, y), (v, u, x)):
            free = 1 - _below(np.abs(along), STREET + 2.2)
            dashes = _below(np.abs(across), 0.12) * _stripes(line, 2.0, 0.55) * free
            zebra = (_below(np.abs(np.abs(along) - STREET - 0.9), 0.6)
                     * _stripes(across, 0.8, 0.5) * _below(np.abs(across), STREET - 0.2))
            colour = _mix(colour, [0.85, 0.84, 0.80], np.maximum(dashes, zebra) * road * 0.9)
        return colour

    def _building(self, box: NDArray[np.integer], points: NDArray[np.float64],
                  normals: NDArray[np.float64]) -> NDArray[np.float64]:
        low, high = self.city.boxes[box, 0], self.city.boxes[box, 1]
        stain = self.noise(points, 2.3)
        grain = self.noise(points, 0.45)
        rows = np.arange(len(box))

        # roof: weathered, with a bright parapet
        edge = np.minimum(points - low, high - points)[:, :2].min(axis=1)
        roof = self.roofs[box] * (0.72 + 0.35 * stain + 0.15 * grain)[:, None]
        roof = _mix(roof, np.array([0.80, 0.79, 0.76]), _below(edge, 0.3))

        # facade: a whole number of bays and storeys, so that no window is cut off
        along = np.where(np.abs(normals[:, 0]) > 0.5, 1, 0)
        width = (high - low)[rows, along]
        bay = width / np.maximum(np.round(width / self.bays[box]), 1)
        storey = high[:, 2] / np.maximum(np.round(high[:, 2] / self.storeys[box]), 1)
        column = (points - low)[rows, along] / bay
        floor = points[:, 2] / storey
        pane = np.minimum(
            _below(np.abs(column % 1 - 0.5) * bay, self.window_share[box, 0] * bay / 2),
            _below(np.abs(floor % 1 - 0.5) * storey, self.window_share[box, 1] * storey / 2))
        index = [(np.floor(part).astype(int) + shift) % LATTICE for part, shift in
                 ((column, 0), (floor, 0), (box * 4 + along * 2 + (normals.sum(axis=1) > 0), 5))]
        lit = self.lattice[tuple(index)]
        glass = np.array([0.20, 0.25, 0.31]) + np.maximum(lit - 0.6, 0)[:, None] * (0.9, 0.8, 0.6)
        wall = self.facades[box] * (0.85 + 0.2 * stain + 0.1 * grain)[:, None]
        wall = _mix(wall, self.facades[box] * 0.65, _below(points[:, 2], 0.25))
        wall = _mix(wall, self.facades[box] * 1.15, _below(high[:, 2] - points[:, 2], 0.2))
        wall = wall * (1 - pane[:, None]) + glass * pane[:, None]
        return np.where(normals[:, 2:] > 0.5, roof, wall)

    def _plant(self, box: NDArray[np.integer], points: NDArray[np.float64],
               normals: NDArray[np.float64]) -> NDArray[np.float64]:
        grey = np.array([0.72, 0.73, 0.74]) * (0.8 + 0.25 * self.noise(points, 0.6))[:, None]
        return _mix(grey, [0.35, 0.36, 0.38], 0.7 * _stripes(points[:, 2], 0.5, 0.4)
                    * (normals[:, 2] < 0.5))

    def _car(self, box: NDArray[np.integer], points: NDArray[np.float64],
             normals: NDArray[np.float64]) -> NDArray[np.float64]:
        wheels = _below(points[:, 2], 0.14)
        return _mix(self.cars[box], [0.10, 0.10, 0.11], wheels)

    def _cabin(self, box: NDArray[np.integer], points: NDArray[np.float64],
               normals: NDArray[np.float64]) -> NDArray[np.float64]:
        # a cabin follows its car in the list; its top has the car's colour, its sides are glass
        glass = np.array([0.16, 0.19, 0.23])
        return np.where(normals[:, 2:] > 0.5, self.cars[box - 1] * 0.95, glass)

    def _trunk(self, box: NDArray[np.integer], points: NDArray[np.float64],
               normals: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.array([0.36, 0.27, 0.20]) * (0.8 + 0.4 * self.noise(points, 0.4))[:, None]

    def _leaves(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        tone = self.noise(points, 5.0)
        clump = self.noise(points, 0.9)
        leaf = self.noise(points, 0.4)
        green = _mix(np.array([0.18, 0.34, 0.12]), [0.48, 0.50, 0.18], tone)
        return green * (0.45 + 0.55 * clump + 0.4 * leaf)[:, None]
