"""Pack a scene whose poses are disturbed at random, as a poor reconstruction would have them.

    python -m tools.studies.disturbed_poses SCENE DEGREES OUT.npz
    clsplat plan OUT.npz

Photos of a place then disagree about its colour. All cameras are disturbed, those of held-out
photos too: each turns by DEGREES in the root mean square, and moves by as much of the typical
depth. `clsplat plan` states the limits that follow. `clsplat train` takes all steps with
--visits all, and gaussians may grow with a number for --pixels-per-gaussian.
"""

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np

from clsplat.io.packed import write_packed
from clsplat.io.scenes import read_scene
from clsplat.placement.corrections import Correction, typical_depth

SEED = 7


def disturbed(scene, degrees):
    """The scene with other poses.

    Parameters
    ----------
    scene : as it was read.
    degrees : of the turns, root mean square.
    """
    rng = np.random.default_rng(SEED)
    depth = typical_depth([view.camera for view in scene.views], scene.points)
    deviation = np.radians(degrees) / np.sqrt(3)  # of each of three parts
    views = []
    for view in scene.views:
        turn, shift = rng.normal(size=(2, 3)) * deviation
        views.append(replace(view, camera=Correction(turn, depth * shift).applied(view.camera)))
    return replace(scene, views=tuple(views))


def main(argv=None):
    """Write the scene."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scene", type=Path)
    parser.add_argument("degrees", type=float)
    parser.add_argument("out", type=Path)
    options = parser.parse_args(argv)
    write_packed(disturbed(read_scene(options.scene, ""), options.degrees), options.out)


if __name__ == "__main__":
    main()
