"""The gaussians at dense points with which one run of the whole scene would begin.

Blocks begin with those of them that stand in gaps of the coarse model (partition/blocks.py).
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from clsplat.device import Device
from clsplat.gaussians import Gaussians
from clsplat.io.models.ply import read_ply, write_ply
from clsplat.io.photos.depth import with_depths
from clsplat.io.photos.undistort import undistorted
from clsplat.io.runs.city import CityFolder
from clsplat.options import TrainOptions
from clsplat.scene import Scene
from clsplat.training.photos import THREADS
from clsplat.training.progress import SilentProgress
from clsplat.training.start.initialise import first_gaussians
from clsplat.training.start.prepare import prepare


def find_dense_gaussians(city: CityFolder, scene: Scene, options: TrainOptions, device: Device,
                         progress: SilentProgress | None = None) -> None:
    """Write CITY/dense.ply, where one run of the whole scene would begin at dense points.

    They are found once for the whole, as photos are in several blocks. A city that is cut already
    stays as it is.

    Parameters
    ----------
    city : its folder, with a finished coarse run.
    scene, options : the whole.
    device : which compares the photos.
    progress : receives what is being done.

    Raises
    ------
    InputError : they were requested, and cannot be had.
    """
    if city.has_partition or city.dense.is_file():
        return
    scene = undistorted(with_depths(scene, options.depth), city.undistorted, THREADS)
    prepared = prepare(scene, replace(options, snapshots=False))  # the coarse run has these
    if prepared.options.init != "dense":
        return
    gaussians, _ = first_gaussians(device, prepared, progress or SilentProgress())
    write_ply(city.dense, gaussians.with_sh_degree(0).scaled(prepared.scene.unit), scene.offset,
              sphere=True)


def dense_gaussians(city: CityFolder, scene: Scene, sh_degree: int) -> Gaussians | None:
    """The gaussians of CITY/dense.ply in the scene's frame; None without that file."""
    if not city.dense.is_file():
        return None
    return read_ply(city.dense, scene.offset).with_sh_degree(sh_degree)


def counted_where(coarse: Gaussians, dense: Gaussians | None) -> NDArray[np.float64]:
    """How many gaussians blocks begin with, counted where the coarse ones stand, as float64[N].

    These are a coarse gaussian itself and the dense points to which it is the nearest. Blocks of
    equal counts take about equal memory and time.

    Parameters
    ----------
    coarse : N gaussians.
    dense : at dense points, in the same frame; None: there are none.
    """
    counts = np.ones(coarse.count)
    if dense is not None:
        tree = cKDTree(coarse.positions, balanced_tree=False)
        _, nearest = tree.query(dense.positions, workers=-1)
        counts += np.bincount(nearest, minlength=coarse.count)
    return counts
