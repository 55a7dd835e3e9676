"""Colours of the city's surfaces as functions of the surface point: the same from every view.

Edges are ramps of EDGE_WIDTH and the finest noise has cells of 0.4 units, so that no detail is
smaller than a pixel of the default survey (about 0.13 units). A Texture with `detail`, the pixel of
a finer survey, has sharper edges, finer noise that does not repeat, and small features besides.

texture.h has the same functions for devices.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tools.synth.city import BLOCK_WIDTH, KINDS, PAVEMENT, STREET, City

EDGE_WIDTH = 0.12  # world units
EDGE_PIXELS = 1.3  # width of an edge in a Texture with detail
COARSEST_GRAIN = 0.25  # world units, cells of the coarsest octave of `grain`
LATTICE = 32  # cells after which the noise repeats
FACADES = np.array(
    [
        [0.80, 0.68, 0.50],
        [0.68, 0.36, 0.27],
        [0.82, 0.79, 0.73],
        [0.58, 0.54, 0.50],
        [0.88, 0.72, 0.42],
        [0.48, 0.58, 0.66],
        [0.80, 0.56, 0.45],
        [0.56, 0.65, 0.50],
    ]
)
ROOFS = np.array([[0.58, 0.57, 0.55], [0.62, 0.36, 0.27], [0.46, 0.47, 0.50], [0.70, 0.67, 0.60], [0.40, 0.50, 0.38]])
CARS = np.array(
    [
        [0.80, 0.80, 0.80],
        [0.20, 0.22, 0.25],
        [0.70, 0.15, 0.13],
        [0.18, 0.32, 0.60],
        [0.55, 0.56, 0.58],
        [0.85, 0.70, 0.20],
    ]
)
PARTS = np.array(
    [
        [0.72, 0.72, 0.70],
        [0.45, 0.24, 0.18],
        [0.16, 0.20, 0.30],
        [0.88, 0.88, 0.86],
        [0.30, 0.31, 0.33],
        [0.55, 0.42, 0.28],
    ]
)


def _mix(first: NDArray[np.float64], second: ArrayLike, weight: NDArray[np.float64]) -> NDArray[np.float64]:
    """Linear interpolation from `first` to `second`."""
    return first + (np.asarray(second) - first) * weight[:, None]


def _hash(x: NDArray[np.integer], y: NDArray[np.integer], z: NDArray[np.integer]) -> NDArray[np.float64]:
    """A number from 0 to 1 for each triple of whole numbers [N]."""
    x, y, z = (np.asarray(part).astype(np.int64).astype(np.uint32) for part in (x, y, z))
    value = x * np.uint32(0x8DA6B343) ^ y * np.uint32(0xD8163841) ^ z * np.uint32(0xCB1AB31F)
    for shift, factor in ((15, 0x2C1B3C6D), (12, 0x297A2D39), (15, 1)):
        value = (value ^ value >> np.uint32(shift)) * np.uint32(factor)
    return (value >> np.uint32(8)) / 2**24


def _to_street(coordinate: NDArray[np.float64], count: int) -> NDArray[np.float64]:
    """Signed distance to the nearest of the count + 1 street centre lines."""
    line = np.clip(np.round(coordinate / BLOCK_WIDTH + count / 2), 0, count)
    return coordinate - (line - count / 2) * BLOCK_WIDTH


class Texture:
    """The colours of one city; `albedo` is a pure function of the surface point. `detail` is the
    size of the finest features, world units; 0: those of the default survey."""

    def __init__(self, city: City, detail: float = 0.0) -> None:
        rng = np.random.default_rng([city.seed, 2])
        count = len(city.boxes)
        self.city, self.detail = city, detail
        self.edge = min(EDGE_WIDTH, EDGE_PIXELS * detail) if detail else EDGE_WIDTH
        # of the grain, whose finest cells have two pixels
        self.octaves = max(1, int(np.log2(COARSEST_GRAIN / detail))) if detail else 0
        self.lattice = rng.random((LATTICE,) * 3)
        # in turn, so that neighbouring buildings differ
        turn = np.cumsum(city.kinds == KINDS.index("building")) + rng.integers(0, 40)
        self.facades = FACADES[3 * turn % len(FACADES)] * rng.uniform(0.85, 1.1, (count, 1))
        self.roofs = ROOFS[2 * turn % len(ROOFS)] * rng.uniform(0.85, 1.1, (count, 1))
        self.cars = CARS[rng.integers(0, len(CARS), count)]
        self.bays = rng.uniform(1.0, 1.6, count)  # approximate distance between windows
        self.storeys = rng.uniform(1.0, 1.4, count)
        self.window_share = rng.uniform(0.45, 0.65, (count, 2))
        self.parts = PARTS[rng.integers(0, len(PARTS), count)] * rng.uniform(0.85, 1.1, (count, 1))

    def _below(self, value: NDArray[np.float64], edge: float | NDArray[np.float64]) -> NDArray[np.float64]:
        """1 where value < edge and 0 where it is larger, with a ramp between them."""
        return np.clip((edge - value) / self.edge + 0.5, 0, 1)

    def _stripes(self, value: NDArray[np.float64], period: float, share: float) -> NDArray[np.float64]:
        """1 on stripes that fill `share` of each `period`, with soft edges."""
        off_centre = np.abs((value / period) % 1 - 0.5) * period
        return self._below(off_centre, share * period / 2)

    def noise(self, points: NDArray[np.float64], scale: float) -> NDArray[np.float64]:
        """Value noise [N], 0 to 1, with cells of `scale` world units (Perlin's cubic fade)."""
        cell = points / scale
        low = np.floor(cell)
        fade = cell - low
        fade = fade * fade * (3 - 2 * fade)
        low = low.astype(np.int64)
        high = low + 1
        x, y, z = fade.T
        value = np.zeros(len(points))
        for ix, wx in ((low[:, 0], 1 - x), (high[:, 0], x)):
            for iy, wy in ((low[:, 1], 1 - y), (high[:, 1], y)):
                for iz, wz in ((low[:, 2], 1 - z), (high[:, 2], z)):
                    value = value + wx * wy * wz * self._corner(ix, iy, iz)
        return value

    def _corner(self, x: NDArray[np.integer], y: NDArray[np.integer], z: NDArray[np.integer]) -> NDArray[np.float64]:
        """The random number [N] of corners of cells; with detail it does not repeat."""
        if self.detail:
            return _hash(x, y, z)
        corners: NDArray[np.float64] = self.lattice[x % LATTICE, y % LATTICE, z % LATTICE]
        return corners

    def grain(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Fine noise [N] about zero, of octaves down to `detail`; 0 without it."""
        total = np.zeros(len(points))
        for octave in range(self.octaves):
            total += self.noise(points + 17.3 * octave, COARSEST_GRAIN / 2**octave) - 0.5
        return total / max(self.octaves, 1) ** 0.5

    def albedo(
        self, primitive: NDArray[np.integer], points: NDArray[np.float64], normals: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Colours [N, 3], 0 to 1, of surface points and their normals [N, 3], world, on primitives
        [N]: 0 for the ground, then boxes, then spheres."""
        colour = np.empty_like(points)
        boxes = len(self.city.boxes)
        on = primitive == 0
        colour[on] = self._ground(points[on])
        on = primitive > boxes
        colour[on] = self._leaves(points[on])
        kind = np.full(len(points), -1)
        on = (primitive > 0) & (primitive <= boxes)
        kind[on] = self.city.kinds[primitive[on] - 1]
        for name, paint in (
            ("building", self._building),
            ("plant", self._plant),
            ("car", self._car),
            ("cabin", self._cabin),
            ("trunk", self._trunk),
            ("part", self._part),
        ):
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
        grain = self.grain(points)
        lawn = lawn * (0.8 + 0.25 * middle + 0.15 * fine + 0.9 * grain)[:, None]
        yard = np.array([0.60, 0.57, 0.52]) * (0.82 + 0.18 * middle + 0.12 * fine)[:, None]
        joints = np.maximum(self._stripes(x, 1.5, 0.1), self._stripes(y, 1.5, 0.1))
        yard = yard * (1 - 0.15 * joints)[:, None]
        if self.detail:
            slab = _hash(np.floor(x / 0.5), np.floor(y / 0.5), np.zeros(len(x)))
            joints = np.maximum(self._stripes(x, 0.5, 0.07), self._stripes(y, 0.5, 0.07))
            yard = yard * ((0.88 + 0.24 * slab + 0.35 * grain) * (1 - 0.35 * joints))[:, None]
            yard = _mix(yard, lawn, self._below(0.56, self.noise(points + 20, 4.0)))
        place = np.stack([x, y]) / BLOCK_WIDTH + np.array(city.blocks)[:, None] / 2
        block = np.clip(np.floor(place).astype(int), 0, np.array(city.blocks)[:, None] - 1)
        path = np.hypot(*((place - block - 0.5) * BLOCK_WIDTH))
        path = self._below(np.abs(path - 0.55 * (BLOCK_WIDTH / 2 - STREET - PAVEMENT)), 0.6)
        park = _mix(lawn, [0.72, 0.65, 0.50], path)
        inside = np.where(city.parks[tuple(block)][:, None], park, yard)
        colour = _mix(lawn, inside, self._below(built, 0))

        near = np.minimum(np.abs(u), np.abs(v))
        outer = self._below(built, STREET + PAVEMENT)
        pavement = np.array([0.66, 0.65, 0.63]) * (0.88 + 0.2 * middle)[:, None]
        if self.detail:
            pavement = pavement * ((0.9 + 0.2 * slab + 0.3 * grain) * (1 - 0.3 * joints))[:, None]
            pavement = _mix(pavement, [0.80, 0.79, 0.76], self._below(np.abs(near - STREET), 0.12))
        colour = _mix(colour, pavement, self._below(near, STREET + PAVEMENT) * outer)
        asphalt = np.array([0.33, 0.34, 0.36]) * (0.8 + 0.2 * middle + 0.2 * fine)[:, None]
        if self.detail:
            mended = self._below(0.68, self.noise(points + 40, 1.3))
            crack = self._below(np.abs(self.noise(points + 80, 0.9) - 0.5) * 0.9, 0.012)
            asphalt = asphalt * ((1 + 0.7 * grain) * (1 - 0.3 * mended) * (1 - 0.3 * crack))[:, None]
        road = self._below(near, STREET) * self._below(built, STREET)
        colour = _mix(colour, asphalt, road)
        for across, along, line in ((u, v, y), (v, u, x)):
            free = 1 - self._below(np.abs(along), STREET + 2.2)
            dashes = self._below(np.abs(across), 0.12) * self._stripes(line, 2.0, 0.55) * free
            zebra = (
                self._below(np.abs(np.abs(along) - STREET - 0.9), 0.6)
                * self._stripes(across, 0.8, 0.5)
                * self._below(np.abs(across), STREET - 0.2)
            )
            colour = _mix(colour, [0.85, 0.84, 0.80], np.maximum(dashes, zebra) * road * 0.9)
        return colour

    def _building(
        self, box: NDArray[np.integer], points: NDArray[np.float64], normals: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        low, high = self.city.boxes[box, 0], self.city.boxes[box, 1]
        stain = self.noise(points, 2.3)
        grain = self.noise(points, 0.45)
        rows = np.arange(len(box))

        # roof: weathered, with a bright parapet
        edge = np.minimum(points - low, high - points)[:, :2].min(axis=1)
        roof = self.roofs[box] * (0.72 + 0.35 * stain + 0.15 * grain)[:, None]
        fine = self.grain(points)
        if self.detail:  # rows of tiles or sheets, each of its own tone
            x, y = points[:, 0] / 0.34, points[:, 1] / 0.26
            tile = _hash(np.floor(x), np.floor(y), box)
            seam = np.maximum(self._stripes(points[:, 0], 0.34, 0.1), self._stripes(points[:, 1], 0.26, 0.12))
            moss = self._below(0.66, self.noise(points + 60, 0.8))
            roof = roof * ((0.84 + 0.32 * tile + 0.7 * fine) * (1 - 0.35 * seam))[:, None]
            roof = _mix(roof, [0.33, 0.34, 0.28], 0.6 * moss)
        roof = _mix(roof, np.array([0.80, 0.79, 0.76]), self._below(edge, 0.3))

        # facade: a whole number of bays and storeys, so that no window is cut off
        along = np.where(np.abs(normals[:, 0]) > 0.5, 1, 0)
        width = (high - low)[rows, along]
        bay = width / np.maximum(np.round(width / self.bays[box]), 1)
        storey = high[:, 2] / np.maximum(np.round(high[:, 2] / self.storeys[box]), 1)
        column = (points - low)[rows, along] / bay
        floor = points[:, 2] / storey
        pane = np.minimum(
            self._below(np.abs(column % 1 - 0.5) * bay, self.window_share[box, 0] * bay / 2),
            self._below(np.abs(floor % 1 - 0.5) * storey, self.window_share[box, 1] * storey / 2),
        )
        index = [
            (np.floor(part).astype(int) + shift) % LATTICE
            for part, shift in ((column, 0), (floor, 0), (box * 4 + along * 2 + (normals.sum(axis=1) > 0), 5))
        ]
        lit = self.lattice[tuple(index)]
        glass = np.array([0.20, 0.25, 0.31]) + np.maximum(lit - 0.6, 0)[:, None] * (0.9, 0.8, 0.6)
        wall = self.facades[box] * (0.85 + 0.2 * stain + 0.1 * grain)[:, None]
        wall = _mix(wall, self.facades[box] * 0.65, self._below(points[:, 2], 0.25))
        wall = _mix(wall, self.facades[box] * 1.15, self._below(high[:, 2] - points[:, 2], 0.2))
        if self.detail:  # courses, frames, and bars that divide the windows
            course = self._stripes(floor * storey, 0.25, 0.12)
            wall = wall * ((1 + 0.3 * fine) * (1 - 0.12 * course))[:, None]
            frame = np.minimum(
                *(
                    self._below(np.abs(part % 1 - 0.5) * size, self.window_share[box, axis] * size / 2 + 0.07)
                    for axis, (part, size) in enumerate(((column, bay), (floor, storey)))
                )
            )
            wall = _mix(wall, [0.86, 0.85, 0.82], frame)
            bar = self._below(np.abs(column % 1 - 0.5) * bay, 0.025)
            glass = _mix(glass, [0.80, 0.79, 0.76], bar)
        wall = wall * (1 - pane[:, None]) + glass * pane[:, None]
        return np.where(normals[:, 2:] > 0.5, roof, wall)

    def _plant(
        self, box: NDArray[np.integer], points: NDArray[np.float64], normals: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        grey = np.array([0.72, 0.73, 0.74]) * (0.8 + 0.25 * self.noise(points, 0.6))[:, None]
        return _mix(grey, [0.35, 0.36, 0.38], 0.7 * self._stripes(points[:, 2], 0.5, 0.4) * (normals[:, 2] < 0.5))

    def _car(
        self, box: NDArray[np.integer], points: NDArray[np.float64], normals: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        wheels = self._below(points[:, 2], 0.14)
        return _mix(self.cars[box], [0.10, 0.10, 0.11], wheels)

    def _cabin(
        self, box: NDArray[np.integer], points: NDArray[np.float64], normals: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        # a cabin follows its car in the list; its top has the car's colour, its sides are glass
        glass = np.array([0.16, 0.19, 0.23])
        return np.where(normals[:, 2:] > 0.5, self.cars[box - 1] * 0.95, glass)

    def _trunk(
        self, box: NDArray[np.integer], points: NDArray[np.float64], normals: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        return np.array([0.36, 0.27, 0.20]) * (0.8 + 0.4 * self.noise(points, 0.4))[:, None]

    def _part(
        self, box: NDArray[np.integer], points: NDArray[np.float64], normals: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        # the flue of a chimney, the rim of a skylight
        low, high = self.city.boxes[box, 0], self.city.boxes[box, 1]
        edge = np.minimum(points - low, high - points)[:, :2].min(axis=1)
        colour = self.parts[box] * (1 + 0.4 * self.grain(points))[:, None]
        return _mix(colour, [0.62, 0.62, 0.60], self._below(edge, 0.03) * (normals[:, 2] > 0.5))

    def _leaves(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        tone = self.noise(points, 5.0)
        clump = self.noise(points, 0.9)
        leaf = self.noise(points, 0.4)
        green = _mix(np.array([0.18, 0.34, 0.12]), [0.48, 0.50, 0.18], tone)
        return green * np.maximum(0.45 + 0.55 * clump + 0.4 * leaf + 1.6 * self.grain(points), 0.2)[:, None]
