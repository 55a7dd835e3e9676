"""Write a scene whose photos are made to disagree about the colours of a place.

    python -m tools.studies.disagreeing SCENE OUT --shadows 12 --test-offset 3
    clsplat plan OUT --test-offset 3

--poses turns each camera, those of held-out photos too, by so many degrees in the root mean square,
and moves it by as much of the typical depth, as a poor reconstruction would have it. --noise adds
to each pixel and channel of the photos to train on, --shadows multiplies them by smooth spots a
tenth of the width in size, as passing clouds do; both are standard deviations in % and leave the
held-out photos as they are. `clsplat plan` states the limits that follow. `clsplat train` takes all
steps with --visits all.
"""

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.ndimage import gaussian_filter

from clsplat.io.photos.images import encode_jpeg
from clsplat.io.photos.views import read_photo
from clsplat.io.scenes.read import read_scene
from clsplat.io.scenes.write import QUALITY, write_scene
from clsplat.placement.corrections import Correction, typical_depth

SEED = 7
SPOT = 0.1  # of the width: the standard deviation of the filter that makes a shadow


def with_other_poses(scene, degrees):
    """The scene with cameras that are turned by so many degrees, root mean square."""
    rng = np.random.default_rng(SEED)
    depth = typical_depth([view.camera for view in scene.views], scene.points)
    deviation = np.radians(degrees) / np.sqrt(3)  # of each of three parts
    views = []
    for view in scene.views:
        turn, shift = rng.normal(size=(2, 3)) * deviation
        views.append(replace(view, camera=Correction(turn, depth * shift).applied(view.camera)))
    return replace(scene, views=tuple(views))


def with_other_photos(scene, training, changed):
    """The scene with other photos to train on.

    Parameters
    ----------
    training : the views whose photos change.
    changed : called with a generator of random numbers and a photo float[h, w, 3] of 0 to 255;
        returns the new one.
    """
    rng = np.random.default_rng(SEED)
    names = {view.name for view in training}
    return replace(scene, views=tuple(
        replace(view, source=encode_jpeg(
            np.clip(np.rint(changed(rng, read_photo(view).astype(float))), 0, 255).astype(np.uint8),
            QUALITY)) if view.name in names else view for view in scene.views))


def noisy(percent):
    """A change that adds noise of this standard deviation, % of full brightness."""
    return lambda rng, photo: photo + rng.normal(scale=2.55 * percent, size=photo.shape)


def shadowed(percent):
    """A change that multiplies by smooth spots whose logarithm has this standard deviation, %."""
    def changed(rng, photo):
        height, width = photo.shape[:2]
        spread = SPOT * width
        field = gaussian_filter(rng.normal(size=(2 * height, 2 * width)), spread)
        field *= np.sqrt(4 * np.pi) * spread  # the filter leaves this part of the deviation
        middle = field[height // 2:height // 2 + height, width // 2:width // 2 + width]
        return photo * np.exp(percent / 100 * middle)[..., None]
    return changed


def main(argv=None):
    """Write the scene."""
    parser = argparse.ArgumentParser(description=__doc__,
                                     formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scene", type=Path)
    parser.add_argument("out", type=Path)
    kinds = parser.add_mutually_exclusive_group(required=True)
    kinds.add_argument("--poses", type=float, metavar="DEGREES")
    kinds.add_argument("--noise", type=float, metavar="PERCENT")
    kinds.add_argument("--shadows", type=float, metavar="PERCENT")
    parser.add_argument("--test-every", type=int, default=8)
    parser.add_argument("--test-offset", type=int, default=0)
    options = parser.parse_args(argv)
    scene = read_scene(options.scene, "")
    if options.poses is not None:
        scene = with_other_poses(scene, options.poses)
    else:
        change = noisy(options.noise) if options.shadows is None else shadowed(options.shadows)
        training, _ = scene.split(options.test_every, options.test_offset)
        scene = with_other_photos(scene, training, change)
    write_scene(options.out, scene, linked=False)


if __name__ == "__main__":
    main()
