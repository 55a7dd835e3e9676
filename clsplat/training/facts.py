"""What a schedule knows about a scene before training."""

from collections.abc import Sequence
from weakref import WeakKeyDictionary

from clsplat.covisibility.disagreement import colour_disagreement
from clsplat.covisibility.source_views import photos_of_a_point
from clsplat.gaussians import mean_inverse_distance
from clsplat.partition.blocks import seen_pixels
from clsplat.scene import Scene, View
from clsplat.schedule import SceneFacts
from clsplat.training.photos import decoded, with_side

SMALL_SIDE = 256  # pixels of the photos whose colours are compared
RUNS, RUN = 4, 12  # of photos that follow each other, and so show the same places
_KNOWN = WeakKeyDictionary[Scene, dict[tuple[View, ...], float]]()


def scene_facts(scene: Scene, views: Sequence[View]) -> SceneFacts:
    """The facts of a scene for its schedule, where gaussians begin at its sparse points.

    Parameters
    ----------
    scene : at the size of training.
    views : the training views of the scene.
    """
    return SceneFacts(
        smallest_size(views), len(scene.points), mean_inverse_distance(scene.points) / scene.unit,
        lambda: (photo[:3] for photo in decoded(views)), seen_pixels(scene, views),
        lambda: _known_disagreement(scene, tuple(views)), photos_of_a_point(scene, views))


def _known_disagreement(scene: Scene, views: tuple[View, ...]) -> float:
    """The result of `_disagreement`, for which several stages of a city ask."""
    known = _KNOWN.setdefault(scene, {})
    if views not in known:
        known[views] = _disagreement(scene, views)
    return known[views]


def _disagreement(scene: Scene, views: Sequence[View]) -> float:
    """The disagreement of some of the photos, at a small size."""
    if len(views) > RUNS * RUN:
        views = [views[begin * (len(views) - RUN) // (RUNS - 1) + number]
                 for begin in range(RUNS) for number in range(RUN)]
    small = with_side(views, SMALL_SIDE)
    return colour_disagreement(scene, small, decoded(small))


def smallest_size(views: Sequence[View]) -> tuple[int, int]:
    """(width, height) of the training image with the shortest side, pixels."""
    return min(((view.camera.width, view.camera.height) for view in views), key=min)
