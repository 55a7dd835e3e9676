"""Facts about a scene for its schedule, before training."""

from collections.abc import Sequence
from functools import cache, partial

from clsplat.covisibility.disagreement import colour_disagreement
from clsplat.covisibility.source_views import photos_of_a_point
from clsplat.gaussians import mean_inverse_distance
from clsplat.scene import Scene, View
from clsplat.schedule import SceneFacts
from clsplat.training.photos import decoded
from clsplat.training.start.thumbnails import Thumbnails

RUNS, RUN = 4, 12  # of photos that follow each other, and so show the same places


def scene_facts(scene: Scene, views: Sequence[View], thumbnails: Thumbnails | None = None
                ) -> SceneFacts:
    """The facts of a scene for its schedule, if gaussians begin at its sparse points.

    Parameters
    ----------
    scene : the scene at the size of training.
    views : its training views.
    thumbnails : of these views.
    """
    return SceneFacts(
        smallest_size(views), len(scene.points), mean_inverse_distance(scene.points) / scene.unit,
        lambda: (photo[:3] for photo in decoded(views)),
        sum(view.camera.width * view.camera.height for view in views),
        cache(partial(_disagreement, scene, thumbnails or Thumbnails(views))),
        photos_of_a_point(scene, views))


def _disagreement(scene: Scene, thumbnails: Thumbnails) -> float:
    """The disagreement of some of the photos."""
    count = len(thumbnails.views)
    chosen = range(count) if count <= RUNS * RUN else [
        begin * (count - RUN) // (RUNS - 1) + number
        for begin in range(RUNS) for number in range(RUN)]
    return colour_disagreement(scene, *thumbnails.of(chosen))


def smallest_size(views: Sequence[View]) -> tuple[int, int]:
    """(width, height) of the training image with the shortest side, pixels."""
    return min(((view.camera.width, view.camera.height) for view in views), key=min)
