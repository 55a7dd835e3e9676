"""The initial gaussians and responses of a training."""

import os
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from clsplat.config.option import AUTO, is_auto
from clsplat.densify.sphere import with_spheres
from clsplat.errors import InputError
from clsplat.gaussians import Gaussians
from clsplat.io.models.formats import count_of, is_model, read_model
from clsplat.io.models.quantise import morton_order
from clsplat.io.scenes.options import SceneOptions
from clsplat.options import TrainOptions
from clsplat.scene import Scene
from clsplat.schedule import SceneFacts, schedule_of

POINTS = ("sfm", "dense", "random")  # at which training begins where --init names no file
FEWEST_GAUSSIANS = 2  # their distance gives new gaussians a size


def initial_gaussians(scene: Scene, options: TrainOptions,
                      dense: tuple[NDArray[np.float64], NDArray[np.uint8]] | None = None
                      ) -> Gaussians:
    """Gaussians at the sparse points, at dense points (positions and colours), at random points
    within their bounds, or from a file of gaussians or points.

    They have spheres if the options request it. Those of a coarse run are in an order in which
    neighbours lie together in memory, since a view sees a small part of them: of 39,600 gaussians,
    steps then take 3/4 of the time. Raises InputError where they are more than the options allow,
    or where the file cannot be used.
    """
    if dense is not None:
        gaussians = Gaussians.from_points(*dense, options.sh_degree)
    elif options.init in (AUTO, "sfm"):
        gaussians = Gaussians.from_points(scene.points, scene.colours, options.sh_degree)
    elif options.init == "random":
        rng = np.random.default_rng([options.seed, 0])
        low, high = np.percentile(scene.points, (1, 99), axis=0)
        points = rng.uniform(low, high, scene.points.shape)
        colours = rng.integers(0, 256, scene.points.shape).astype(np.uint8)
        gaussians = Gaussians.from_points(points, colours, options.sh_degree)
    else:
        if not os.path.exists(options.init):
            raise InputError(
                f"{options.init}: no such file; --init expects sfm, dense, random or a file")
        if not is_model(options.init):
            raise InputError(f"{options.init}: a folder; --init expects sfm, dense, random or a "
                             "file, such as the point_cloud.ply of a run")
        gaussians = read_model(options.init, scene.offset, scene.georeference).scaled(
            1 / scene.unit)
        if gaussians.count < FEWEST_GAUSSIANS:
            raise InputError(
                f"{options.init}: has {gaussians.count} gaussians, and a training starts from at "
                f"least {FEWEST_GAUSSIANS}; give another file to --init, or leave it out")
        gaussians = gaussians.with_sh_degree(options.sh_degree)
    if options.coarse:
        order = morton_order(gaussians.positions)
        gaussians = Gaussians({name: rows[order] for name, rows in gaussians.rows.items()},
                              gaussians.sh_degree)
    constrained = options.sphere and "spheres" in schedule_of(options.schedule).parts
    if constrained and "anchors" not in gaussians.rows:
        gaussians = with_spheres(gaussians, options.sphere_neighbours)
    if not constrained:  # drop the spheres of a file
        gaussians = gaussians.without_spheres()
    if options.max_gaussians and gaussians.count > options.max_gaussians:
        raise InputError(f"--max-gaussians {options.max_gaussians}: the scene starts with "
                         f"{gaussians.count}; allow at least that many")
    return gaussians


def planned_initial(facts: SceneFacts, options: SceneOptions) -> SceneFacts:
    """The facts with the number of gaussians in the file at which training begins, if it does.

    Parameters
    ----------
    facts : with the number of points at which it begins otherwise.
    """
    points = is_auto(options.init) or options.init in POINTS
    # which a run that goes on no longer needs
    if points or not (os.path.exists(options.init) and is_model(options.init)):
        return facts
    return replace(facts, count=count_of(options.init))
