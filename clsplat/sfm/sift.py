"""SIFT features of photos on the device (cl/sift.cl has the method and its sources)."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from clsplat.constants import DESCRIPTOR_SIZE, NO_ANGLE, SIFT_LEVELS, SIFT_PADDING, SIFT_SCALES, SIFT_SIGMA
from clsplat.device import Array, Device, Forms, Kernel, each, groups

PHOTO_SIGMA = 0.5  # pixels, by which a photo is blurred; as in COLMAP, also an enlarged one
OCTAVES = 4  # as COLMAP
SMALLEST = 8  # pixels, sides of an octave
COLUMNS = 16  # a row of an image is a multiple of so many
CUT = 4.0  # sigma, where a Gaussian ends
ROOM = 16  # pixels a keypoint, for which there is room at first

_SIZE = dict(width="uint", height="uint", stride="uint")
_BLOCKS = Forms(item=each(f"height stride/{COLUMNS}"), group=each("height stride"))
GREY = Kernel(
    "sift.cl",
    "grey",
    each("height stride"),
    source_width="uint",
    source_height="uint",
    **_SIZE,
    target="uint",
    pixels=("uchar", "P"),
    levels=("real", "L"),
)
SMOOTH_COLUMNS = Kernel(
    "sift.cl",
    "smooth_columns",
    _BLOCKS,
    **_SIZE,
    source="uint",
    radius="uint",
    taps=("real", "T"),
    levels=("real", "L"),
    smoothed=("real", "S"),
)
SMOOTH_ROWS = Kernel(
    "sift.cl",
    "smooth_rows",
    Forms(item=each("height"), group=each("height stride")),
    **_SIZE,
    before="uint",
    target="uint",
    difference="uint",
    radius="uint",
    taps=("real", "T"),
    smoothed=("real", "S"),
    levels=("real", "L"),
    differences=("real", "D"),
)
HALVE = Kernel(
    "sift.cl",
    "halve",
    each("height stride"),
    **_SIZE,
    source_stride="uint",
    source="uint",
    target="uint",
    levels=("real", "L"),
)
EXTREMA = Kernel(
    "sift.cl",
    "extrema",
    Forms(item=each(f"{SIFT_SCALES} height stride/{COLUMNS}"), group=each(f"{SIFT_SCALES} height stride")),
    **_SIZE,
    octave="uint",
    first_cell="uint",
    room="uint",
    differences=("real", "D"),
    keypoints=("real", "N", 4),
    cells=("uint", "N"),
    found=("uint", 1),
)
DESCRIBE = Kernel(
    "sift.cl",
    "describe",
    Forms(item=each("count"), group=groups("count", "SCAN_GROUP")),
    count="uint",
    keypoints=("real", "N", 4),
    octaves=("int", "O", 4),
    levels=("real", "L"),
    angles=("real", "N", 2),
    descriptors=("uchar", "N", 2, DESCRIPTOR_SIZE),
)


class Octave(NamedTuple):
    """Where an octave lies among the levels of all, and its size in pixels."""

    begin: int
    width: int
    height: int
    stride: int

    def level(self, number: int) -> int:
        """Where one of its images begins."""
        return self.begin + number * self.height * self.stride


def octaves_of(width: int, height: int) -> list[Octave]:
    """The octaves of an image of this size; none if it is very small."""
    result: list[Octave] = []
    begin = 0
    while len(result) < OCTAVES and min(width, height) >= SMALLEST:
        stride = -(-width // COLUMNS) * COLUMNS
        result.append(Octave(begin, width, height, stride))
        begin += SIFT_LEVELS * height * stride
        width, height = (width + 1) // 2, (height + 1) // 2
    return result


class Sift:
    """Finds SIFT features on a device.

    Parameters
    ----------
    most : features of a photo; of more, the largest are kept.
    """

    def __init__(self, device: Device, most: int) -> None:
        self.device, self.most = device, most
        self._taps: dict[float, Array] = {}

    def features(
        self, pixels: NDArray[np.uint8], width: int, height: int
    ) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
        """The features of a photo, the largest first.

        Parameters
        ----------
        pixels : uint8[h, w, 3].
        width, height : of the image in which features are searched, at least the photo's.

        Returns
        -------
        float32[N, 4], x and y in pixels of that image, where the centre of the first is (0.5, 0.5),
        scale in its pixels and orientation, radians from x towards y; and uint8[N, 128], RootSIFT
        times 512.
        """
        octaves = octaves_of(width, height)
        if not octaves:
            return np.empty((0, 4), np.float32), np.empty((0, DESCRIPTOR_SIZE), np.uint8)
        last = octaves[-1]
        levels = self.device.empty(last.level(SIFT_LEVELS))
        everywhere, cells = self._keypoints(levels, octaves, pixels)
        keypoints = everywhere[np.lexsort((cells, -_scales(everywhere)))[: self.most]]
        angles, descriptors = self._described(levels, octaves, keypoints)
        rows, slots = np.nonzero(angles > NO_ANGLE)
        rows, slots = rows[: self.most], slots[: self.most]
        chosen = keypoints[rows]
        return np.column_stack(
            [chosen[:, :2] * 2.0 ** chosen[:, 3:] + 0.5, _scales(chosen), angles[rows, slots]]
        ).astype(np.float32), descriptors[rows, slots]

    def _keypoints(
        self, levels: Array, octaves: list[Octave], pixels: NDArray[np.uint8]
    ) -> tuple[NDArray[np.floating], NDArray[np.uint32]]:
        """As the kernels' keypoints [N, 4] and cells uint[N]; fills the levels."""
        device, first = self.device, octaves[0]
        source_height, source_width, _ = pixels.shape
        size = first.height * first.stride
        differences = device.empty((SIFT_LEVELS - 1) * size + 2 * SIFT_PADDING)
        smoothed = device.empty(first.height * (first.stride + 2 * SIFT_PADDING))
        uploaded = device.upload(pixels.reshape(-1))
        room = max(size // ROOM, 1)
        while True:
            found = device.empty(1, np.uint32)
            found.fill(0)
            found_at, cells = device.empty((room, 4)), device.empty(room, np.uint32)
            # the enlarged photo lies where level 1 comes later
            device.launch(
                GREY,
                source_width=source_width,
                source_height=source_height,
                **_size(first),
                target=first.level(1),
                levels=levels,
                pixels=uploaded,
            )
            for number, octave in enumerate(octaves):
                if number:
                    before = octaves[number - 1]
                    device.launch(
                        HALVE,
                        **_size(octave),
                        source_stride=before.stride,
                        source=before.level(SIFT_SCALES),
                        target=octave.begin,
                        levels=levels,
                    )
                else:
                    self._smooth(octave, 1, 0, math.sqrt(SIFT_SIGMA**2 - PHOTO_SIGMA**2), levels, smoothed, differences)
                for level in range(1, SIFT_LEVELS):
                    sigma = SIFT_SIGMA * 2 ** ((level - 1) / SIFT_SCALES) * math.sqrt(2 ** (2 / SIFT_SCALES) - 1)
                    self._smooth(octave, level - 1, level, sigma, levels, smoothed, differences)
                device.launch(
                    EXTREMA,
                    **_size(octave),
                    octave=number,
                    first_cell=octave.begin,
                    room=room,
                    differences=differences,
                    keypoints=found_at,
                    cells=cells,
                    found=found,
                )
            count = int(found.download()[0])
            if count <= room:
                break
            room = count  # noise has more
        places, rows = np.unique(cells.narrow(count).download(), return_index=True)
        return found_at.narrow(count).download()[rows], places

    def _smooth(
        self, octave: Octave, before: int, after: int, sigma: float, levels: Array, smoothed: Array, differences: Array
    ) -> None:
        """One level from another, and their difference in place of the lower one."""
        if sigma not in self._taps:
            away = np.arange(math.ceil(CUT * sigma) + 1)
            weights = np.exp(-0.5 * (away / sigma) ** 2)
            self._taps[sigma] = self.device.upload(weights / (2 * weights.sum() - 1))
        taps = self._taps[sigma]
        self.device.launch(
            SMOOTH_COLUMNS,
            **_size(octave),
            source=octave.level(before),
            radius=len(taps) - 1,
            taps=taps,
            levels=levels,
            smoothed=smoothed,
        )
        self.device.launch(
            SMOOTH_ROWS,
            **_size(octave),
            before=octave.level(before),
            target=octave.level(after),
            difference=min(before, after) * octave.height * octave.stride,
            radius=len(taps) - 1,
            taps=taps,
            smoothed=smoothed,
            levels=levels,
            differences=differences,
        )

    def _described(
        self, levels: Array, octaves: list[Octave], keypoints: NDArray[np.floating]
    ) -> tuple[NDArray[np.floating], NDArray[np.uint8]]:
        """As the kernels' angles [N, 2] and descriptors uint8[N, 2, 128]."""
        device, count = self.device, len(keypoints)
        angles = device.empty((count, 2))
        descriptors = device.empty((count, 2, DESCRIPTOR_SIZE), np.uint8)
        device.launch(
            DESCRIBE,
            count=count,
            keypoints=device.upload(keypoints),
            levels=levels,
            octaves=device.upload(np.array(octaves, np.int32)),
            angles=angles,
            descriptors=descriptors,
        )
        return angles.download(), descriptors.download()


def _size(octave: Octave) -> dict[str, int]:
    return dict(width=octave.width, height=octave.height, stride=octave.stride)


def _scales(keypoints: NDArray[np.floating]) -> NDArray[np.floating]:
    """Sigma of keypoints [N, 4], in pixels of the first octave."""
    return SIFT_SIGMA * 2.0 ** (keypoints[:, 2] / SIFT_SCALES + keypoints[:, 3])
