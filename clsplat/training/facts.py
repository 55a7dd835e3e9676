"""What a schedule knows about a scene before training."""

from collections.abc import Sequence

from clsplat.covisibility.overlap import mean_overlap
from clsplat.gaussians import mean_inverse_distance
from clsplat.partition.blocks import seen_pixels
from clsplat.scene import Scene, View
from clsplat.schedule import SceneFacts
from clsplat.training.photos import decoded


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
        mean_overlap(scene, views))


def smallest_size(views: Sequence[View]) -> tuple[int, int]:
    """(width, height) of the training image with the shortest side, pixels."""
    return min(((view.camera.width, view.camera.height) for view in views), key=min)
