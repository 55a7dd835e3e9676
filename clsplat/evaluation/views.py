"""Renders of a model beside the photos of a scene, and what they score."""

from pathlib import Path

import numpy as np

from clsplat.errors import InputError
from clsplat.evaluation.colour import fit_colour
from clsplat.evaluation.error_map import error_map
from clsplat.evaluation.floaters import floater_share, ground_truth
from clsplat.evaluation.metrics import psnr, ssim
from clsplat.evaluation.pictures import Pictures, chosen_views, shown_view
from clsplat.io.folders import make_folder
from clsplat.io.images import read_photo, write_image
from clsplat.io.regular import native
from clsplat.rendering.slabs import open_model

PANELS = ("photo", "render", "render after the colour fit", "its error")  # of PNG files
SAMPLED = 24  # training views to choose pictures from, where no view is held out
SCORES = ("psnr", "ssim", "psnr_cc", "ssim_cc")


def render_view(renderer, rows, degree, camera):
    """float32[H, W, 3] in 0..1: what a Camera sees."""
    frame = renderer.render(rows, renderer.pack(camera), camera.width, camera.height, degree)
    return np.clip(frame.image.download().transpose(1, 2, 0), 0, 1)


def evaluate_views(renderer, rows, degree, views, keep=None):
    """Scores of renders from the views' cameras against their photos, resampled to that size.

    Returns {"views", "psnr", "ssim", "psnr_cc", "ssim_cc", "per_view"}: means over views, dB and
    0..1; `_cc` after the quadratic colour fit of each render to its photo. keep: called with
    (view, image, fitted image, photo), each float[H, W, 3], for every view.
    """
    per_view = []
    for view in views:
        image = render_view(renderer, rows, degree, view.camera)
        photo = photo_of(view)
        fitted = fit_colour(image, photo)
        scores = (psnr(image, photo), ssim(image, photo), psnr(fitted, photo), ssim(fitted, photo))
        per_view.append({"name": view.name, **dict(zip(SCORES, scores))})
        if keep:
            keep(view, image, fitted, photo)
    means = {score: float(np.mean([v[score] for v in per_view])) for score in SCORES}
    return {"views": len(per_view), **means, "per_view": per_view}


def pictures_of(renderer, rows, degree, test, train, per_view=None):
    """The Pictures of a model: of `test`, the held-out views, or where there are none of at most
    SAMPLED views of `train`, spread evenly.

    per_view: the scores of `test` as `evaluate_views` lists them; None: they are made here. What is
    chosen is rendered again, so that no more than one view is in memory at full size.
    """
    views = test or train[::-(-len(train) // SAMPLED)]
    if not (test and per_view):
        per_view = evaluate_views(renderer, rows, degree, views)["per_view"]
    shown = []
    for place, index in chosen_views(per_view):
        def keep(_, image, fitted, photo, place=place, scores=per_view[index]):
            shown.append(shown_view(place, scores, fitted, photo))
        evaluate_views(renderer, rows, degree, [views[index]], keep)
    return Pictures(shown, bool(test), len(views))


def photo_of(view):
    """float32[H, W, 3] in 0..1: the view's photo at its camera's size."""
    return read_photo(view) / np.float32(255)


def opened(device, gaussians, scene, options):
    """(renderer, rows, SH degree) of finished Gaussians, to render views of a Scene as TrainOptions
    say."""
    renderer, rows = open_model(device, gaussians, scene.near(options.near), options.antialiased,
                                options.background)
    return renderer, rows, gaussians.sh_degree


def evaluate_run(run, device, save_images, scene_path=None):
    """`evaluate_views` of a Run's finished model on its held-out views, and their `pictures`;
    `save_images` writes PANELS side by side as PNG into the run. scene_path: where the scene is
    now; None takes what the run has recorded. Where the scene has its ground truth, the result
    also holds `floaters.floater_share`."""
    options, scene = run.options, run.scene(scene_path)
    train, views = scene.split(options.test_every)
    if not views:
        raise InputError(f"{run.path}: no held-out views (--test-every {options.test_every}); "
                         "nothing to compare with")
    gaussians, city = run.finished_model, ground_truth(scene.path)
    model = run.opened(device, scene, gaussians)

    def keep(view, image, fitted, photo):
        error = error_map(fitted, photo) / np.float32(255)
        beside = np.concatenate([photo, image, fitted, error], axis=1)
        write_image(run.folder.render_path("test", view.name), beside)

    if save_images:
        run.folder.note_renders("test", [view.name for view in views])
    result = evaluate_views(*model, views, keep if save_images else None)
    if city:
        cameras = [view.camera for view in train]
        result.update(floater_share(city, gaussians, cameras, scene.offset))
    result["pictures"] = pictures_of(*model, views, train, result["per_view"])
    return result


def training_pictures(run, device):
    """The Pictures of a Run's finished model where it holds out no view."""
    scene = run.scene()
    return pictures_of(*run.opened(device, scene), [], scene.views)


def render_views(draw, views, folder, beside=False):
    """Write what `draw` makes of each view's Camera, float[H, W, 3], to FOLDER/NAME.png.

    beside: put the photo at the render's right.
    """
    for view in views:
        image = draw(view.camera)
        if beside:
            image = np.concatenate([image, photo_of(view)], axis=1)
        path = Path(folder) / native(f"{view.name}.png")
        make_folder(path.parent)
        write_image(path, image)
