"""Renders of a model beside the photos of a scene, and their scores."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from clsplat.camera import Camera
from clsplat.device import Device
from clsplat.device.host import host_memory
from clsplat.errors import InputError
from clsplat.evaluation.align import aligned
from clsplat.evaluation.held_out_responses import Predicted, predicted_responses
from clsplat.evaluation.metrics import Lpips, fit_colour, flip, psnr, ssim
from clsplat.evaluation.pictures import Pictures, ShownView, chosen_views, error_map, shown_view
from clsplat.gaussians import Gaussians
from clsplat.io.ahead import called_ahead
from clsplat.io.folders import make_folder
from clsplat.io.photos.images import write_image
from clsplat.io.photos.views import read_photo, read_valid
from clsplat.io.runs.run import read_exposures
from clsplat.placement.corrections import typical_depth
from clsplat.rendering.options import RenderingOptions
from clsplat.rendering.slabs import ModelRenderer, open_model
from clsplat.response import Response
from clsplat.scene import Scene, View

if TYPE_CHECKING:
    from clsplat.evaluation.run import Run

Image = NDArray[np.floating]  # [H, W, 3], 0 to 1
Valid = NDArray[np.bool_] | None  # [H, W], the pixels that count; None: all
Model = tuple[ModelRenderer, Any, int]  # on a device: the renderer, its rows and the SH degree
PANELS = ("photo", "render", "render after the colour fit", "its error")  # of PNG files
MOST_SAMPLED = 24  # training views from which to choose pictures, where no view is held out
SCORING_SHARE = 0.1  # of host memory, for views that are scored at the same time
SCORED_PIXEL_BYTES = 160  # measured, of the colour fit or of FLIP
SCORED_PIXEL_SECONDS = 2e-6  # measured, of a core, with METRICS
SAMPLED_SIDE = 1600  # pixels of their photos' longer sides at most; a page shows fewer
Metric = Callable[[Image, Image, Valid], float]  # of an image and its photo
METRICS: Mapping[str, Metric] = {"psnr": psnr, "ssim": ssim}  # of a training
FINAL_METRICS: Mapping[str, Metric] = {**METRICS, "flip": flip}  # of `clsplat eval`


def final_metrics(lpips: str | PathLike[str] | None = None) -> Mapping[str, Metric]:
    """FINAL_METRICS, and LPIPS by the network of an ONNX file, unless that is None or ""."""
    return FINAL_METRICS if not lpips else {**FINAL_METRICS, "lpips": Lpips(lpips)}


def render_view(renderer: ModelRenderer, rows: Any, degree: int, camera: Camera) -> Image:
    """float32[H, W, 3], 0 to 1: the image of a camera."""
    return _shown(_drawn(renderer, rows, degree, camera), camera)


def _drawn(renderer: ModelRenderer, rows: Any, degree: int, camera: Camera) -> Image:
    """float32[H, W, 3]: the colours of the scene, which few lie outside of 0 to 1."""
    frame = renderer.render(rows, renderer.pack(camera), camera.width, camera.height, degree)
    image: Image = frame.image.download().transpose(1, 2, 0)
    return image


def _shown(image: Image, camera: Camera, response: Response | None = None) -> Image:
    """float32[H, W, 3], 0 to 1: colours of the scene, or the photo by this response of them."""
    return np.clip(response.applied(image, camera) if response else image, 0, 1)


def evaluate_views(
    renderer: ModelRenderer,
    rows: Any,
    degree: int,
    views: Sequence[View],
    keep: Callable[..., object] | None = None,
    metrics: Mapping[str, Metric] = METRICS,
    predicted: Predicted | None = None,
    align: float = 0.0,
) -> dict[str, Any]:
    """Compare renders from the cameras of views with their photos.

    Parameters
    ----------
    renderer, rows, degree : a model on the device; see `opened`.
    keep : called for every view with (view, image, fitted image, photo, which pixels count).
    metrics : by their names.
    predicted : the responses of the views; None: they are rendered as the model is.
    align : world units, a typical depth, with which the pose of each view is also aligned with its
        photo (align.py); 0: it is not.

    Returns
    -------
    {"views", "psnr", "ssim", "psnr_cc", "ssim_cc", ..., "per_view"}: means over views, dB and 0 to
    1; `_cc` after the quadratic colour fit of each render to its photo. Masked pixels do not count,
    and a view without others is left out. With `predicted` also "exposure_weight", its weight. With
    `align` also all scores from the aligned poses, with the suffix `_aligned`, and the size of the
    corrections: `aligned_degrees`, and `aligned_shift` as a share of the depth.
    """
    responses = predicted.responses if predicted else {}
    per_view: list[dict[str, Any]] = []
    names = [name + suffix for suffix in ("", "_cc") for name in metrics]
    if align:
        names += [f"{name}_aligned" for name in names] + ["aligned_degrees", "aligned_shift"]

    def rendered() -> Iterator[tuple[View, list[Image], Valid, list[float]]]:
        for view in views:
            valid = read_valid(view)
            if valid is not None and not valid.any():
                continue
            renders, sizes = [_drawn(renderer, rows, degree, view.camera)], []
            if align:
                correction = aligned(renderer, rows, degree, view, align)
                renders.append(_drawn(renderer, rows, degree, correction.applied(view.camera)))
                sizes = [correction.degrees, float(np.linalg.norm(correction.shift)) / align]
            yield view, renders, valid, sizes

    def scored(
        view: View, renders: list[Image], valid: Valid, sizes: list[float]
    ) -> tuple[dict[str, Any], tuple[Any, ...]]:
        photo, response = photo_of(view), responses.get(view.name)
        images = [_shown(image, view.camera, response) for image in renders]
        shown = [each for image in images for each in (image, fit_colour(image, photo, valid))]
        scores = [metric(each, photo, valid) for each in shown for metric in metrics.values()]
        return ({"name": view.name, **dict(zip(names, [*scores, *sizes]))}, (view, *shown[:2], photo, valid))

    most = scored_at_once(views)
    for of_view, shown in called_ahead(scored, rendered(), most, most):
        per_view.append(of_view)
        if keep:
            keep(*shown)
    means = {name: float(np.mean([scores[name] for scores in per_view])) if per_view else math.nan for name in names}
    applied = {"exposure_weight": predicted.weight} if predicted else {}
    return {"views": len(per_view), **means, **applied, "per_view": per_view}


def scored_at_once(views: Sequence[View]) -> int:
    """How many views are scored at the same time, each in a thread: as many as fit the memory."""
    pixels = max((view.camera.width * view.camera.height for view in views), default=1)
    fit = SCORING_SHARE * host_memory() / (SCORED_PIXEL_BYTES * pixels)
    return int(max(1, min(os.cpu_count() or 1, fit)))


def expected_seconds(views: Sequence[View]) -> float:
    """About how long it takes to score renders of these views by METRICS."""
    pixels = sum(view.camera.width * view.camera.height for view in views)
    return SCORED_PIXEL_SECONDS * pixels / scored_at_once(views)


def pictures_of(
    renderer: ModelRenderer,
    rows: Any,
    degree: int,
    test: Sequence[View],
    train: Sequence[View],
    per_view: list[dict[str, Any]] | None = None,
    predicted: Predicted | None = None,
) -> Pictures:
    """The pictures of a model's report; the chosen views are rendered again, so that few are in
    memory at full size.

    Parameters
    ----------
    renderer, rows, degree : the model on the device; see `opened`.
    test : the held-out views, which are shown.
    train : the training views; where none is held out, at most MOST_SAMPLED of them are rendered,
        and whole photos of more than SAMPLED_SIDE pixels a side are reduced to that.
    per_view : the scores of `test` as `evaluate_views` lists them; None: they are computed here.
    predicted : as for `evaluate_views`.
    """
    views = test or [
        replace(view, camera=view.camera.reduced(1, SAMPLED_SIDE)) for view in train[:: -(-len(train) // MOST_SAMPLED)]
    ]
    if not (test and per_view):
        per_view = evaluate_views(renderer, rows, degree, views, predicted=predicted)["per_view"]
    shown: list[ShownView] = []
    chosen, by_name = chosen_views(per_view), {view.name: view for view in views}

    def keep(_view: View, _image: Image, fitted: Image, photo: Image, valid: Valid) -> None:
        place, index = chosen[len(shown)]
        shown.append(shown_view(place, per_view[index], fitted, photo, valid))

    evaluate_views(
        renderer,
        rows,
        degree,
        [by_name[per_view[index]["name"]] for _, index in chosen],
        keep,
        metrics={},
        predicted=predicted,
    )
    return Pictures(shown, bool(test), len(views))


def photo_of(view: View) -> NDArray[np.float32]:
    """[H, W, 3], 0 to 1: the photo of a view at its camera's size."""
    photo: NDArray[np.float32] = np.divide(read_photo(view), 255, dtype=np.float32)
    return photo


def opened(device: Device, gaussians: Gaussians, scene: Scene, options: RenderingOptions) -> Model:
    """A finished model, in the frame of the scene, on a device.

    The scene decides, with `options.near`, where the near plane is."""
    renderer, rows = open_model(device, gaussians, scene.near(options.near), options.antialiased, options.background)
    return renderer, rows, gaussians.sh_degree


def evaluate_run(
    run: Run,
    device: Device,
    save_images: bool,
    scene: Scene | None = None,
    metrics: Mapping[str, Metric] = FINAL_METRICS,
    align: bool = False,
    model: Model | None = None,
) -> dict[str, Any]:
    """Compare the finished model of a run with its held-out photos.

    Parameters
    ----------
    run, device : the run, and an open device.
    save_images : whether PANELS are written into the run, side by side as PNG.
    scene : as `Run.scene` returns it; None: it is read.
    metrics : by their names.
    align : whether to compare from aligned poses as well.
    model : the finished one, as `Run.opened` returns it; None: it is read.

    Returns
    -------
    The result of `evaluate_views`, with `pictures`.

    Raises
    ------
    InputError : the run is not finished, or holds out no view.
    """
    options, scene = run.options, scene or run.scene()
    train, views = scene.split(options.test_every, options.test_offset)
    if not views:
        raise InputError(
            f"{run.path}: no held-out views (--test-every {options.test_every or 'none'}); nothing to compare with"
        )
    model = model or run.opened(device, scene)

    def keep(view: View, image: Image, fitted: Image, photo: Image, valid: Valid) -> None:
        error = error_map(fitted, photo, valid) / np.float32(255)
        beside = np.concatenate([photo, image, fitted, error], axis=1)
        write_image(run.folder.picture(view.name), beside)

    predicted = predicted_responses(scene.views, read_exposures(run.path))
    result = evaluate_views(
        *model, views, keep if save_images else None, metrics, predicted, depth_to_align(scene) if align else 0.0
    )
    result["pictures"] = pictures_of(*model, views, train, result["per_view"], predicted)
    return result


def depth_to_align(scene: Scene) -> float:
    """The `align` of `evaluate_views` for the views of a scene."""
    return typical_depth([view.camera for view in scene.views], scene.points)


def training_pictures(run: Run, device: Device) -> Pictures:
    """The pictures of a run's finished model where the run holds out no view."""
    scene = run.scene()
    return pictures_of(
        *run.opened(device, scene),
        [],
        scene.views,
        predicted=predicted_responses(scene.views, read_exposures(run.path)),
    )


def render_views(draw: Callable[[Camera], Image], views: Sequence[View], folder: Path, beside: bool = False) -> None:
    """Write pictures [H, W, 3], 0 to 1, of views, FOLDER/NAME.png; `beside`: with the photo at the
    right."""
    for view in views:
        image = draw(view.camera)
        if beside:
            image = np.concatenate([image, photo_of(view)], axis=1)
        path = Path(folder) / f"{view.name}.png"
        make_folder(path.parent)
        write_image(path, image)
