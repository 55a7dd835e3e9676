"""Which features of photos are alike, on the device (cl/match.cl has the method)."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from clsplat.constants import DESCRIPTOR_SIZE, TWO_VIEW_REALS
from clsplat.device import Array, Device, Forms, Kernel, each, groups
from clsplat.device.kernel import Argument

BLOCK = 16  # features that lie beside each other on the device
UNIT = 512.0  # length of a descriptor
MOST_RATIO = 0.8  # of the angles to the nearest and the second nearest descriptor (Lowe 2004)
MOST_RATIO_THERE = 0.65  # where few features are compared, so that a second one is rarely near
MOST_ANGLE = 0.7  # radians, to the nearest one

_PAIRS: dict[str, Argument] = dict(pair_count="uint", pairs=("int", "P", 2))
_FOUND: dict[str, Argument] = dict(nearest=("int", "P", "K"), products=("real", "P", "K", 2))
INTERLEAVE = Kernel(
    "match.cl",
    "interleave",
    each(f"photos blocks {BLOCK}"),
    photos="uint",
    features="uint",
    blocks="uint",
    counts=("int", "V"),
    descriptors=("uchar", "V", "M", DESCRIPTOR_SIZE),
    spread=("real", "V", "B", DESCRIPTOR_SIZE, BLOCK),
)
NEAREST = Kernel(
    "match.cl",
    "nearest",
    Forms(item=each("pair_count blocks"), group=groups("pair_count K/SCAN_GROUP", "SCAN_GROUP")),
    blocks="uint",
    **_PAIRS,
    spread=("real", "V", "B", DESCRIPTOR_SIZE, BLOCK),
    **_FOUND,
)
FOLLOW = Kernel(
    "match.cl",
    "follow",
    Forms(item=each("pair_count features"), group=groups("pair_count features/SCAN_GROUP", "SCAN_GROUP")),
    features="uint",
    **_PAIRS,
    counts=("int", "V"),
    geometry=("real", "P", TWO_VIEW_REALS),
    points=("real", "V", 2, "K"),
    descriptors=("uchar", "V", "K", DESCRIPTOR_SIZE),
    **_FOUND,
)


class Described(NamedTuple):
    """Features of photos on the device."""

    counts: Array  # int[V], of each photo
    descriptors: Array  # uchar[V, M, 128], M a multiple of 16

    @classmethod
    def of(cls, device: Device, descriptors: Sequence[NDArray[np.uint8]]) -> "Described":
        """The features of photos, uint8[N, 128] each."""
        counts = np.array([len(each) for each in descriptors], np.int32)
        filled = np.zeros((len(counts), rounded(counts.max(initial=1)), DESCRIPTOR_SIZE), np.uint8)
        for row, values in zip(filled, descriptors):
            row[: len(values)] = values
        return cls(device.upload(counts), device.upload(filled))


def rounded(count: int) -> int:
    """The next multiple of a block."""
    return -(-int(count) // BLOCK) * BLOCK


def nearest(described: Described, pairs: NDArray[np.integer], most: int) -> list[NDArray[np.uint32]]:
    """The matches of pairs of photos among their first features.

    Parameters
    ----------
    pairs : int[P, 2], of photos.
    most : features of a photo that are compared.

    Returns
    -------
    uint32[N, 2] of each pair, which features are each other's nearest and much nearer than others.
    """
    device = described.counts.device
    photos, features, _ = described.descriptors.shape
    blocks = min(rounded(most), features) // BLOCK
    spread = device.empty((photos, blocks, DESCRIPTOR_SIZE, BLOCK))
    device.launch(INTERLEAVE, photos=photos, features=features, blocks=blocks, **described._asdict(), spread=spread)
    both_ways, found = _both_ways(device, pairs, blocks * BLOCK)
    device.launch(NEAREST, blocks=blocks, **both_ways, spread=spread, **found)
    return _matches(found, MOST_RATIO)


def follow(
    described: Described, points: Array, pairs: NDArray[np.integer], geometry: NDArray[np.floating]
) -> list[NDArray[np.uint32]]:
    """As `nearest` among all features, of those that lie where the geometry of two views allows.

    Parameters
    ----------
    points : real[V, 2, M], where the features are.
    geometry : float[2, P, 11], as the kernel's, of the pairs and of the same pairs the other way.
    """
    device = described.counts.device
    _, features, _ = described.descriptors.shape
    both_ways, found = _both_ways(device, pairs, features)
    device.launch(
        FOLLOW,
        features=features,
        **both_ways,
        **described._asdict(),
        points=points,
        geometry=device.upload(geometry.reshape(-1, TWO_VIEW_REALS)),
        **found,
    )
    return _matches(found, MOST_RATIO_THERE)


def _both_ways(
    device: Device, pairs: NDArray[np.integer], features: int
) -> tuple[dict[str, Array | int], dict[str, Array]]:
    """Pairs, then the same the other way, and arrays for what is found."""
    rows = np.concatenate([pairs, pairs[:, ::-1]]).astype(np.int32)
    return dict(pair_count=len(rows), pairs=device.upload(rows)), dict(
        nearest=device.empty((len(rows), features), np.int32), products=device.empty((len(rows), features, 2))
    )


def _matches(found: dict[str, Array], most_ratio: float) -> list[NDArray[np.uint32]]:
    """What both ways have in common and the tests of ratio and angle pass."""
    index, products = found["nearest"].download(), found["products"].download()
    angles = np.arccos(np.minimum(products / UNIT**2, 1))
    clear = (angles[..., 0] < most_ratio * angles[..., 1]) & (angles[..., 0] < MOST_ANGLE)
    index[~clear] = -1
    result = []
    for there, back in zip(*np.split(index, 2)):
        rows = np.flatnonzero(there >= 0)
        rows = rows[back[there[rows]] == rows]
        result.append(np.column_stack([rows, there[rows]]).astype(np.uint32))
    return result
