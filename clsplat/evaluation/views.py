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
from clsplat.io.ply import read_ply
from clsplat.io.regular import native
from clsplat.io.run import RunFolder
from clsplat.io.scenes import fingerprint, read_scene
from clsplat.rendering.slabs import open_model
from clsplat.scene import Scene
from clsplat.train_options import TrainOptions, resolve

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


def run_options(run) -> TrainOptions:
    """The TrainOptions that a run was trained with."""
    record = run.read_options()
    known = TrainOptions.__dataclass_fields__
    return resolve({k: v for k, v in record.items() if k in known}, {})


def read_scene_of(run, given=None) -> Scene:
    """The Scene that a run was trained on; given: where it is now, None: where the run has it.
    InputError where that is another scene."""
    path = run.scene_path(given)
    scene = read_scene(path, run_options(run).images)
    wanted = run.read_options().get("fingerprint")
    if wanted is not None and fingerprint(scene) != wanted:
        raise InputError(f"{path}: is not the scene that {run.path} was trained on; give that one "
                         "with --scene")
    return scene


def read_cameras_for(run, given=None):
    """The Scene whose cameras a run is rendered from: its own, or any other that is given."""
    path, images = run.scene_path(given), run_options(run).images
    return read_scene(path, images if given is None or (path / images).is_dir() else "")


def evaluate_run(run, device, save_images, scene_path=None):
    """`evaluate_views` of a run's finished model on its held-out views, and their `pictures`;
    `save_images` writes PANELS side by side as PNG into the run. scene_path: where the scene is
    now; None takes what the run has recorded. Where the scene has its ground truth, the result
    also holds `floaters.floater_share`."""
    options = run_options(run)
    scene = read_scene_of(run, scene_path)
    scene = scene.reduced(options.downscale, options.max_resolution)
    train, views = scene.split(options.test_every)
    if not views:
        raise InputError(f"{run.path}: no held-out views (--test-every {options.test_every}); "
                         "nothing to compare with")
    gaussians, city = _shown(run.load_model(), run.path), ground_truth(scene.path)
    renderer, rows, degree = _opened(device, gaussians, scene, options)

    def keep(view, image, fitted, photo):
        error = error_map(fitted, photo) / np.float32(255)
        beside = np.concatenate([photo, image, fitted, error], axis=1)
        write_image(run.render_path("test", view.name), beside)

    if save_images:
        run.note_renders("test", [view.name for view in views])
    result = evaluate_views(renderer, rows, degree, views, keep if save_images else None)
    if city:
        cameras = [view.camera for view in train]
        result.update(floater_share(city, gaussians, cameras, scene.offset))
    result["pictures"] = pictures_of(renderer, rows, degree, views, train, result["per_view"])
    return result


def training_pictures(run, device):
    """The Pictures of a run's finished model where it holds out no view."""
    options = run_options(run)
    scene = read_scene_of(run)
    scene = scene.reduced(options.downscale, options.max_resolution)
    return pictures_of(*_opened(device, run.load_model(), scene, options), [], scene.views)


def render_views(model, scene_path, folder, device, views="all", beside=False):
    """Render a run or a PLY file from a scene's cameras to PNG files; returns how many.

    scene_path: None takes the run's own scene. views: "all", "test" or "train"; beside: put the
    photo at the render's right.
    """
    model, folder = Path(model), Path(folder)
    if model.is_dir():
        run = RunFolder.open(model)
        options = run_options(run)
        scene = read_cameras_for(run, scene_path)
        gaussians = run.load_model()
    else:
        if scene_path is None:
            raise InputError(f"{model}: a PLY file has no cameras; name them with --scene SCENE")
        options, scene = TrainOptions(max_resolution=0), read_scene(scene_path)
        gaussians = read_ply(model, scene.offset)
    scene = scene.reduced(options.downscale, options.max_resolution)
    train, test = scene.split(options.test_every)
    chosen = {"all": scene.views, "train": train, "test": test}[views]
    if not chosen:
        raise InputError(f"{scene.name}: no {views} views; choose others with --views")
    renderer, rows, degree = _opened(device, _shown(gaussians, model), scene, options)
    for view in chosen:
        image = render_view(renderer, rows, degree, view.camera)
        if beside:
            image = np.concatenate([image, photo_of(view)], axis=1)
        path = folder / native(f"{view.name}.png")
        make_folder(path.parent)
        write_image(path, image)
    return len(chosen)


def _shown(gaussians, path):
    """The gaussians, if there are any; InputError where pictures would show nothing."""
    if not gaussians.count:
        raise InputError(f"{path}: holds no gaussians, so there is nothing to show; give another "
                         "model")
    return gaussians


def _opened(device, gaussians, scene, options):
    """(renderer, rows, degree) of a finished model."""
    renderer, rows = open_model(device, gaussians, options.near or scene.near_plane,
                                options.antialiased, options.background)
    return renderer, rows, gaussians.sh_degree
