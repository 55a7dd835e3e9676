"""Checks before training for what keeps a scene from becoming a good model: one line each.

These are warnings; none of them stops a training.
"""

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from clsplat.camera import Camera
from clsplat.constants import ALPHA_STEPS
from clsplat.covisibility.photometry import LUMA
from clsplat.scene import LEAST_PARALLAX, Scene, View
from clsplat.training.photos import Thumbnails

SAMPLED_PHOTOS = 16
SAMPLED_POINTS = 10_000
CELLS = 8  # across a photo, to measure how much of it the points cover
FEW_PHOTOS, FEW_POINTS = 10, 100
LEAST_COVER = 0.05  # of a photo's cells; 0.6 to 1 in four aerial and street scenes
LEAST_CONTRAST = 2.0  # grey levels, standard deviation: less is a uniform photo
LEAST_SMOOTHNESS = 0.2  # correlation of neighbouring pixels: 0.65 to 0.98 in those scenes
FAINTEST = -np.log(ALPHA_STEPS - 1.0)  # logit of 1 / ALPHA_STEPS: nothing fainter is drawn


def find_warnings(scene: Scene, thumbnails: Thumbnails, opacity_logits: NDArray[np.floating]
                  ) -> list[str]:
    """Find problems that will spoil a training, one sentence each; thumbnails are of its training
    views, and opacity_logits [N] of the initial gaussians."""
    chosen, photos = thumbnails.sampled(SAMPLED_PHOTOS)
    problems = (scene.notes, _few(len(thumbnails.views), len(opacity_logits)),
                _faint(opacity_logits), _parallax(scene), _cover(scene.points, chosen),
                _photos(chosen, list(photos)))
    return [text for texts in problems for text in texts]


def _few(photos: int, gaussians: int) -> Iterator[str]:
    if photos < FEW_PHOTOS:
        yield f"only {photos} training photos: 20 or more make a good model"
    if gaussians < FEW_POINTS:
        yield (f"only {gaussians} initial gaussians: growth has little to start from; reconstruct "
               "the scene with more points")


def _faint(opacity_logits: NDArray[np.floating]) -> Iterator[str]:
    faint = np.count_nonzero(opacity_logits < FAINTEST)
    if faint > len(opacity_logits) / 2:
        yield (f"{faint} of {len(opacity_logits)} initial gaussians are too faint to be drawn, and "
               "what is not drawn does not learn")


def _parallax(scene: Scene) -> Iterator[str]:
    if not scene.parallax >= LEAST_PARALLAX:
        yield ("the photos were taken from one place (apart by no more than "
               f"{scene.parallax:.1g} of the points' distance): depth cannot be learned")


def _cover(points: NDArray[np.floating], views: Sequence[View]) -> Iterator[str]:
    """The share of the photos that the sparse points cover."""
    points = points[::-(-len(points) // SAMPLED_POINTS)]
    cover = np.mean([_covered(view.camera, points) for view in views])
    if cover < LEAST_COVER:
        yield (f"the sparse points cover {100 * cover:.0f} % of the photos: check that they belong "
               "to these cameras, and the units of both")


def _covered(camera: Camera, points: NDArray[np.floating]) -> float:
    """The share of an image's cells that contain points."""
    pixels, depths = camera.project(points)
    cells = CELLS * pixels[depths > 0] / (camera.width, camera.height)
    cells = cells[((cells >= 0) & (cells < CELLS)).all(axis=1)].astype(int)
    return len(np.unique(cells @ (CELLS, 1))) / CELLS**2


def _photos(views: Sequence[View], colours: Sequence[NDArray[np.uint8]]) -> Iterator[str]:
    """Photos that are uniform, all the same, or noise."""
    photos = [np.tensordot(LUMA, photo[:3], 1) for photo in colours]
    plain = [view.name for view, photo in zip(views, photos) if photo.std() < LEAST_CONTRAST]
    if plain:
        yield (f"{len(plain)} of {len(views)} sampled photos are of one colour, such as "
               f"{plain[0]}: nothing can be learned from them")
        return
    if len(views) > 1 and all(np.array_equal(photo, photos[0]) for photo in photos):
        yield "all sampled photos are the same: photos from different places must differ"
    noisy = [view.name for view, photo in zip(views, photos)
             if _smoothness(photo) < LEAST_SMOOTHNESS]
    if noisy:
        yield (f"{len(noisy)} of {len(views)} sampled photos are noise, such as {noisy[0]}: "
               "no view agrees with another")


def _smoothness(photo: NDArray[np.floating]) -> float:
    """Correlation of horizontally neighbouring pixels of a grey photo [H, W]."""
    left, right = photo[:, :-1] - photo.mean(), photo[:, 1:] - photo.mean()
    return float((left * right).mean() / photo.var())
