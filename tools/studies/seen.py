"""Which pixels of a held-out photo training photos show, and the scores on these.

Where no training photo looks, no training can know what is there. Held-out photos at the border of
a flight have much of it, and it decides their scores: what a schedule learns shows in the rest.
"""

import numpy as np
import scipy

from clsplat.evaluation.held_out_responses import predicted_responses
from clsplat.evaluation.metrics import fit_colour, flip, psnr
from clsplat.evaluation.views import evaluate_views
from clsplat.io.runs.run import read_exposures

LEAST_VIEWS = 2  # training views that show a place: one tells its colour, but not its depth
STEP = 4  # pixels between places


def seen_pixels(camera, points, cameras):
    """bool[H, W]: the pixels of a camera whose place LEAST_VIEWS of other cameras show or more.

    The depth of a pixel is that of the nearest sparse point in the image, so the answer is the same
    for all trainings of a scene.

    Parameters
    ----------
    points : float[N, 3], sparse points, world.
    cameras : of the training views.
    """
    pixels, depths = camera.project(points)
    shown = camera.shows(points)
    rows, columns = (np.arange(STEP / 2, size, STEP) for size in (camera.height, camera.width))
    grid = np.stack(np.meshgrid(columns, rows), axis=-1)
    _, nearest = scipy.spatial.cKDTree(pixels[shown]).query(grid)
    depth = depths[shown][nearest][..., None]
    rays = np.concatenate([(grid - camera.centre) / camera.focal, np.ones_like(depth)], axis=-1)
    places = ((rays * depth - camera.translation) @ camera.rotation).reshape(-1, 3)
    count = sum(other.shows(places).astype(int) for other in cameras)
    seen = np.reshape(count >= LEAST_VIEWS, depth.shape[:2])
    cells = [
        np.minimum(np.arange(size) // STEP, cells - 1) for size, cells in zip((camera.height, camera.width), seen.shape)
    ]
    return seen[np.ix_(*cells)]


def further_scores(run, device):
    """The scores of a finished run that its training does not have: FLIP, plain and after the
    colour fit, and `psnr_cc_seen`, where the fit and the score are of seen pixels alone."""
    scene, options, on_seen, shares = run.scene(), run.options, [], []
    train, views = scene.split(options.test_every, options.test_offset)
    cameras = [view.camera for view in train]

    def keep(view, image, fitted, photo, valid):
        seen = seen_pixels(view.camera, scene.points, cameras)
        shares.append(seen.mean())
        if seen.any():
            on_seen.append(psnr(fit_colour(image, photo, seen), photo, seen))

    scores = evaluate_views(
        *run.opened(device, scene),
        views,
        keep,
        {"flip": flip},
        predicted_responses(scene.views, read_exposures(run.path)),
    )
    return {
        "flip": scores["flip"],
        "flip_cc": scores["flip_cc"],
        "psnr_cc_seen": float(np.mean(on_seen)),
        "seen": float(np.mean(shares)),
    }
