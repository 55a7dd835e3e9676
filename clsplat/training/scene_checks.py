"""What keeps a scene from becoming a good model, looked for before training: one line each.

None of this stops a training; a user who knows better goes on.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from clsplat.constants import ALPHA_STEPS
from clsplat.covisibility.exposure_drift import LUMA
from clsplat.scene import LEAST_PARALLAX, Scene, View
from clsplat.training.photos import at_level, decoded

SAMPLED_PHOTOS = 16  # photos that stand for all
SMALL_SIDE = 256  # pixels of a photo that is looked at
POINTS = 10_000  # projected into those photos
CELLS = 8  # across a photo, for finding how much of it points cover
FEW_PHOTOS, FEW_POINTS = 10, 100
LEAST_COVER = 0.05  # of a photo's cells; 0.6 to 1 in four aerial and street scenes
LEAST_CONTRAST = 2.0  # grey levels, standard deviation: less is one colour
LEAST_SMOOTHNESS = 0.2  # correlation of neighbouring pixels: 0.65 to 0.98 there, 0 in noise
FAINTEST = -np.log(ALPHA_STEPS - 1.0)  # logit of 1 / ALPHA_STEPS: nothing fainter is drawn


def find_warnings(scene: Scene, views: Sequence[View],
                  opacity_logits: NDArray[np.floating]) -> list[str]:
    """What will spoil a training, with the number behind it; empty where nothing will.

    Parameters
    ----------
    scene : as it is trained on.
    views : of the training; some of their photos are read.
    opacity_logits : [N], of the initial gaussians.
    """
    chosen = views[::-(-len(views) // SAMPLED_PHOTOS)]
    # of a block its city's coarse run has said so
    found = (scene.notes if scene.region is None else (), _few(len(views), len(opacity_logits)),
             _faint(opacity_logits), _parallax(scene), _cover(scene.points, chosen),
             _photos(chosen))
    return [text for texts in found for text in texts]


def _few(photos, gaussians):
    if photos < FEW_PHOTOS:
        yield f"only {photos} training photos: 20 or more make a good model"
    if gaussians < FEW_POINTS:
        yield (f"only {gaussians} initial gaussians: growth has little to start from; reconstruct "
               "the scene with more points")


def _faint(opacity_logits):
    faint = np.count_nonzero(opacity_logits < FAINTEST)
    if faint > len(opacity_logits) / 2:
        yield (f"{faint} of {len(opacity_logits)} initial gaussians are too faint to be drawn, and "
               "what is not drawn does not learn")


def _parallax(scene):
    if not scene.parallax >= LEAST_PARALLAX:
        yield ("the photos were taken from one place (apart by no more than "
               f"{scene.parallax:.1g} of the points' distance): depth cannot be learned")


def _cover(points, views):
    """How much of the photos the sparse points reach."""
    points = points[::-(-len(points) // POINTS)]
    cover = np.mean([_covered(view.camera, points) for view in views])
    if cover < LEAST_COVER:
        yield (f"the sparse points cover {100 * cover:.0f} % of the photos: check that they belong "
               "to these cameras, and the units of both")


def _covered(camera, points):
    """The share of an image's cells that points fall into."""
    pixels, depths = camera.project(points)
    cells = CELLS * pixels[depths > 0] / (camera.width, camera.height)
    cells = cells[((cells >= 0) & (cells < CELLS)).all(axis=1)].astype(int)
    return len(np.unique(cells @ (CELLS, 1))) / CELLS**2


def _photos(views):
    """Photos of one colour, photos that are all the same, photos of noise."""
    side = max(max(view.camera.width, view.camera.height) for view in views)
    photos = [np.tensordot(LUMA, photo, 1)
              for photo in decoded(at_level(views, max(1.0, side / SMALL_SIDE)))]
    plain = [view.name for view, photo in zip(views, photos) if photo.std() < LEAST_CONTRAST]
    if plain:
        yield (f"{len(plain)} of {len(views)} photos looked at are of one colour, such as "
               f"{plain[0]}: nothing can be learned from them")
        return
    if len(views) > 1 and all(np.array_equal(photo, photos[0]) for photo in photos):
        yield "all photos looked at are the same: what moves the camera must change the photo"
    noisy = [view.name for view, photo in zip(views, photos)
             if _smoothness(photo) < LEAST_SMOOTHNESS]
    if noisy:
        yield (f"{len(noisy)} of {len(views)} photos looked at are noise, such as {noisy[0]}: "
               "no view agrees with another")


def _smoothness(photo):
    """Correlation of horizontally neighbouring pixels of float[H, W]."""
    left, right = photo[:, :-1] - photo.mean(), photo[:, 1:] - photo.mean()
    return (left * right).mean() / photo.var()
