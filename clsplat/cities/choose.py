"""Which gaussians of a city a block of it holds, and which of these it trains (cl/choose.cl).

A block trains the gaussians that its region reaches: those it owns, and those in a margin, which
are the neighbours that its outer gaussians have in the whole scene. Behind them its photos show the
rest of the scene. These surroundings are frozen as the coarse run left them. If they were trained,
they would compensate for errors of the block's own gaussians, in a different way in every block:
after merging, caliterra then lost 4 dB. A gaussian that the block owns but that extends beyond its
reach, such as haze, is frozen for the same reason: every block trains its other gaussians with the
same haze. Merging drops margin and surroundings.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy
from numpy.typing import NDArray

from clsplat.constants import CAMERA_REALS
from clsplat.device import Array, Device, Kernel, each
from clsplat.gaussians import Gaussians
from clsplat.partition.region import Region, in_parts, world_of
from clsplat.rendering.project import camera_row
from clsplat.scene import Scene, View

TRAINED_DEVIATIONS = 2.0  # that must lie within a block's reach for the block to train a gaussian
CHUNK_ROWS = 1 << 20  # that are on the device together, which may train a block
_PLACES = dict(positions=("real", "N", 3), log_scales=("real", "N", 3), outside=("uint", "N"))
OUTSIDE = Kernel(
    "choose.cl",
    "choose_outside",
    each("count"),
    count="uint",
    contracted="uint",
    deviations="real",
    step_u="real",
    step_v="real",
    space=("real", 12),
    cell=("real", 6),
    **_PLACES,
)
SIZES = Kernel(
    "choose.cl",
    "choose_sizes",
    each("count"),
    count="uint",
    views="uint",
    cameras=("real", "V", CAMERA_REALS),
    **_PLACES,
    sizes=("real", "N"),
)


@dataclass(frozen=True, eq=False)
class Choice:
    """Which gaussians a block holds.

    Attributes
    ----------
    indices, log_scales : int[K], ascending, and [K, 3], larger for those that stand for others too.
    owned, reached : bool[K], in the block's cell; in that or its margin.
    """

    indices: NDArray[np.integer]
    log_scales: NDArray[np.floating]
    owned: NDArray[np.bool_]
    reached: NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class BlockStart:
    """The gaussians that a block starts from, and how many gaussians of the whole are of each kind.

    Attributes
    ----------
    gaussians, indices : the model, and where its gaussians are among those of the whole, int[K].
    own, margin : in the block's cell, and in the margin around it.
    surroundings : farther away; the model holds them, frozen.
    dense : added at dense points (`filled`); they are last in the model.
    """

    gaussians: Gaussians
    indices: NDArray[np.integer]
    own: int
    margin: int
    surroundings: int
    dense: int = 0


def trainable(
    scene: Scene, region: Region, positions: NDArray[np.floating], log_scales: NDArray[np.floating]
) -> NDArray[np.bool_]:
    """Which gaussians a block trains, as bool[N]; the others are frozen. On the host: how many they
    are is asked before there is a model.

    These are the gaussians that its region reaches with TRAINED_DEVIATIONS standard deviations.
    `positions`, `log_scales` : [N, 3], in the local frame of the scene."""

    def trains(some: NDArray[np.floating], logs: NDArray[np.floating]) -> NDArray[np.bool_]:
        deviations = np.exp(np.maximum.reduce(logs.T).astype(np.float64))
        return region.reaches(world_of(scene, some), scene.unit * TRAINED_DEVIATIONS * deviations)

    return in_parts(trains, positions, log_scales)


def note_outside(
    device: Device,
    scene: Scene,
    region: Region,
    positions: Array,
    log_scales: Array,
    outside: Array,
    deviations: float = TRAINED_DEVIATIONS,
) -> None:
    """Write 1 for rows that a region does not reach with so many of their largest standard
    deviations; see `Region.reaches`.

    Parameters
    ----------
    scene : in whose local frame the rows are.
    positions, log_scales, outside : real[N, 3] twice, and uint[N], where what is 1 stays.
    """
    space, grown = region.space, region.grown(region.margin)
    turn = space.rotation / space.half[:, None]
    step_u, step_v = (scene.unit / space.half[:2]).tolist()
    device.launch(
        OUTSIDE,
        count=len(outside),
        contracted=int(space.contracted),
        deviations=deviations,
        step_u=step_u,
        step_v=step_v,
        space=device.upload(np.concatenate([scene.unit * turn.reshape(-1), turn @ (scene.offset - space.origin)])),
        cell=device.upload(np.concatenate([grown.low, grown.high])),
        positions=positions,
        log_scales=log_scales,
        outside=outside,
    )


def find_sizes(
    device: Device,
    positions: NDArray[np.floating],
    log_scales: NDArray[np.floating],
    scene: Scene,
    region: Region,
    views: Sequence[View],
) -> tuple[NDArray[np.bool_], NDArray[np.float64]]:
    """Which gaussians a region reaches, bool[N], and two standard deviations of each in the view
    that shows it largest, pixels, at most 1: [N], 0 where no view shows it, 1 where it is reached.
    Arguments as for `choose_gaussians`."""
    cameras = device.upload(
        np.reshape([camera_row(view.camera, scene.near_plane) for view in views], (-1, CAMERA_REALS))
    )
    reached, found = np.empty(len(positions), bool), np.empty(len(positions))
    for begin in range(0, len(positions), CHUNK_ROWS):
        part = slice(begin, begin + CHUNK_ROWS)
        places, scales = device.upload(positions[part]), device.upload(log_scales[part])
        outside, sizes = device.zeros(len(places), np.uint32), device.empty(len(places))
        note_outside(device, scene, region, places, scales, outside, deviations=0.0)
        device.launch(
            SIZES,
            count=len(places),
            views=len(views),
            cameras=cameras,
            positions=places,
            log_scales=scales,
            outside=outside,
            sizes=sizes,
        )
        reached[part], found[part] = outside.download() == 0, sizes.download()
    return reached, found


def choose_gaussians(
    device: Device,
    positions: NDArray[np.floating],
    log_scales: NDArray[np.floating],
    scene: Scene,
    region: Region,
    views: Sequence[View],
) -> Choice:
    """Choose the gaussians that the block of a region holds.

    Surroundings that are smaller than a pixel in every view are thinned: where two standard
    deviations are s < 1 pixels, a share of s^2 of them is kept and enlarged by 1 / s, so that
    together they cover the same area (Cook et al. 2007, Stochastic simplification of aggregate
    detail). A distant part of the scene thus costs a block no more than its pixels can show.
    Leaving out all small ones would leave holes: on the sample city, where they are 1 in 14 of a
    model, the views then had a PSNR of 26 dB against the whole model, and 35 dB with thinning.

    `positions`, `log_scales` : [N, 3], in the local frame of the `scene`; `views` : of the block,
    with cameras of the size they are trained at (`Scene.reduced`)."""
    reached, size = find_sizes(device, positions, log_scales, scene, region, views)
    owned = reached.copy()
    owned[reached] = in_parts(lambda some: region.owns(world_of(scene, some)), positions[reached])
    kept = np.flatnonzero(np.random.default_rng(0).random(len(size)) < size**2)
    return Choice(
        kept, (log_scales[kept] - np.log(size[kept])[:, None]).astype(log_scales.dtype), owned[kept], reached[kept]
    )


def block_start(gaussians: Gaussians, chosen: Choice) -> BlockStart:
    """What a block starts from of a coarse model, in the local frame of the whole scene."""
    rows = {name: values[chosen.indices] for name, values in gaussians.rows.items() if name != "log_scales"}
    return BlockStart(
        Gaussians({**rows, "log_scales": chosen.log_scales}, gaussians.sh_degree),
        chosen.indices,
        int(chosen.owned.sum()),
        int((chosen.reached & ~chosen.owned).sum()),
        int((~chosen.reached).sum()),
    )


def filled(start: BlockStart, dense: Gaussians, scene: Scene, region: Region, most: int = 0) -> BlockStart:
    """A start with those dense gaussians, at most to `most` in all, that its region reaches and
    that stand in its gaps: where no other one of the start lies within a gaussian's deviation."""
    positions = dense.positions.astype(np.float64)
    added = np.flatnonzero(in_parts(region.reaches, world_of(scene, positions)))
    if start.gaussians.count:
        distance, _ = scipy.spatial.cKDTree(start.gaussians.positions, balanced_tree=False).query(
            positions[added], workers=-1
        )
        added = added[distance > np.exp(dense.log_scales[added, 0])]
    if most:
        room = max(0, most - start.gaussians.count)
        added = np.sort(np.random.default_rng(0).permutation(added)[:room])
    rows = {name: np.concatenate([values, dense.rows[name][added]]) for name, values in start.gaussians.rows.items()}
    return replace(start, gaussians=Gaussians(rows, start.gaussians.sh_degree), dense=len(added))
