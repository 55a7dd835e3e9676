"""What a training starts from."""

import os
from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from clsplat.densify.sphere import with_spheres
from clsplat.errors import InputError
from clsplat.gaussians import LEARNED, Gaussians
from clsplat.io.ply import read_ply
from clsplat.loss.exposure import IDENTITY
from clsplat.options import TrainOptions
from clsplat.scene import Scene, View
from clsplat.schedule import schedule_of

FEWEST = 2  # gaussians: the distance between them sizes what grows


def initial_gaussians(scene: Scene, options: TrainOptions) -> Gaussians:
    """Gaussians on the sparse points, on random points within their bounds, or from a PLY file.

    With spheres where the options want them. Raises InputError for fewer gaussians allowed than
    given, or a file that cannot be used.
    """
    if options.init == "sfm":
        gaussians = Gaussians.from_points(scene.points, scene.colours, options.sh_degree)
    elif options.init == "random":
        rng = np.random.default_rng([options.seed, 0])
        low, high = np.percentile(scene.points, (1, 99), axis=0)
        points = rng.uniform(low, high, scene.points.shape)
        colours = rng.integers(0, 256, scene.points.shape)
        gaussians = Gaussians.from_points(points, colours, options.sh_degree)
    else:
        if not os.path.exists(options.init):
            raise InputError(
                f"{options.init}: no such file; --init expects sfm, random or a PLY file")
        if os.path.isdir(options.init):
            raise InputError(f"{options.init}: a folder; --init expects sfm, random or a PLY file, "
                             "such as the point_cloud.ply of a run")
        given = read_ply(options.init, scene.offset).scaled(1 / scene.unit)
        if given.count < FEWEST:
            raise InputError(f"{options.init}: has {given.count} gaussians, and a training starts "
                             f"from at least {FEWEST}; give another PLY to --init, or leave it out")
        gaussians = given.with_sh_degree(options.sh_degree)
    constrained = options.sphere and "spheres" in schedule_of(options.schedule).parts
    if constrained and "anchors" not in gaussians.rows:
        gaussians = with_spheres(gaussians, options.sphere_neighbours)
    if not constrained:  # what spheres a file has hold nothing back
        gaussians = Gaussians({field.name: gaussians.rows[field.name] for field in LEARNED},
                              gaussians.sh_degree)
    if options.max_gaussians and gaussians.count > options.max_gaussians:
        raise InputError(f"--max-gaussians {options.max_gaussians}: the scene starts with "
                         f"{gaussians.count}; allow at least that many")
    return gaussians


def initial_exposures(scene: Scene, views: Iterable[View]) -> NDArray[np.float64] | None:
    """[V, 3, 4]: the colour transforms that a block's `views` start from, the identity for one that
    has none; None where the scene is no block, or brings none."""
    if not scene.exposures:
        return None
    return np.array([scene.exposures.get(view.name, IDENTITY) for view in views])
