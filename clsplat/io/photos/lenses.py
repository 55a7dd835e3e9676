"""Camera models with lens distortion: which pinhole cameras their photos are undistorted to.

A lens that sees up to MOST_DEGREES from its axis gets one pinhole camera with the lens's own focal
length in the middle. A wider fisheye and a panorama get up to six, the faces of a cube, which are
views of their own.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.camera import Lens
from clsplat.errors import InputError
from clsplat.scene import rows_by_view

Model = tuple[str, tuple[float, ...]]  # name of a camera model of COLMAP, and parameters
PANORAMA = "EQUIRECTANGULAR"
MOST_DEGREES = 60.0  # from the axis, in a single view: there pixels are stretched fourfold
MOST_LOST = 0.1  # of the photo's pixels, to have an undistorted photo without uncovered pixels
SMALLEST, LARGEST = 0.1, 2.0  # times the photo's sides: of an undistorted photo
LEAST_COVERED = 0.02  # of the pixels of a cube's face
SAMPLES = 64  # along a side of a photo
BAND_PIXELS = 1 << 15  # at once: what is computed for them stays in the cache
MOST_TURN = 0.01  # radians, between a ray and that of the pixel to which it projects
STEP = 1e-3  # relative, by which a ray is turned outwards
SHORT = 1e-6  # of x/z and y/z, for the focal length in the middle
# the rotations from a face's camera to the photo's: right, down, forward in columns
FACES = {
    "front": ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
    "right": ((0, 0, 1), (0, 1, 0), (-1, 0, 0)),
    "back": ((-1, 0, 0), (0, 1, 0), (0, 0, -1)),
    "left": ((0, 0, -1), (0, 1, 0), (1, 0, 0)),
    "up": ((1, 0, 0), (0, 0, -1), (0, 1, 0)),
    "down": ((1, 0, 0), (0, 0, 1), (0, -1, 0)),
}


def undistorted_model(
    path: Path | str, arrays: Mapping[str, NDArray[Any]], models: Sequence[Model | None]
) -> dict[str, NDArray[Any]]:
    """The arrays for `checks.checked_scene` after undistortion.

    Parameters
    ----------
    path : the file that messages name.
    arrays : names, rotations, translations, focals, centres and sizes of the V photos as they are
        stored; perhaps points and observations.
    models : the camera model of each photo; None for a pinhole camera.

    Returns
    -------
    The arrays, with those of the pinhole cameras, the observations in these, `lenses` [V] (None for
    a pinhole camera) and `files` [V], the name of the stored photo: a wide lens has several views.
    """
    if not any(models):
        lenses = np.full(len(models), None, object)
        return {**arrays, "lenses": lenses, "files": arrays["names"]}
    views_of = cache(_lenses)
    rows: list[tuple[int, str, Lens | None]] = []  # photo, face or "", lens
    for index, model in enumerate(models):
        try:
            rows += [
                (index, face, lens)
                for face, lens in (
                    [("", None)] if model is None else views_of(*model, tuple(arrays["sizes"][index].tolist()))
                )
            ]
        except ValueError as error:
            raise InputError(
                f"{path}: the camera of image {arrays['names'][index]} cannot be "
                f"undistorted ({error}); reconstruct the scene again"
            ) from None
    photos = np.array([index for index, _, _ in rows])
    lenses = np.empty(len(rows), object)
    lenses[:] = [lens for _, _, lens in rows]
    turns = np.array([np.eye(3) if lens is None else lens.rotation.T for lens in lenses])
    result = dict(arrays)
    for name in ("rotations", "translations", "focals", "centres", "sizes"):
        result[name] = arrays[name][photos]
    names = map(str, arrays["names"][photos])
    result["names"] = np.array(
        [
            str(PurePosixPath(name).with_suffix(f".{face}{PurePosixPath(name).suffix}")) if face else name
            for name, (_, face, _) in zip(names, rows)
        ],
        np.str_,
    )
    result["rotations"] = turns @ result["rotations"]
    result["translations"] = (turns @ result["translations"][:, :, None])[:, :, 0]
    for row, lens in enumerate(lenses):
        if lens is not None:
            result["sizes"][row] = lens.width, lens.height
            result["focals"][row], result["centres"][row] = lens.focal, lens.centre
    if len(arrays.get("observations", ())):
        result["observations"] = _observations(result, photos, arrays["observations"])
    return {**result, "lenses": lenses, "files": arrays["names"][photos]}


def _observations(
    model: Mapping[str, NDArray[Any]], photos: NDArray[np.int64], known: NDArray[Any]
) -> NDArray[np.int32]:
    """int32[M, 2], rows (point, view), from rows (point, photo): each in the views that show it."""
    points_of = [known[rows, 0] for rows in rows_by_view(known[:, 1], 1 + max(photos.max(), known[:, 1].max()))]
    views_of, found = np.bincount(photos), []
    for view, photo in enumerate(photos):
        points = points_of[photo]
        if views_of[photo] > 1:
            seen = model["points"][points] @ model["rotations"][view].T + model["translations"][view]
            pixels = _tangents(seen) * model["focals"][view] + model["centres"][view]
            points = points[((pixels >= 0) & (pixels < model["sizes"][view])).all(axis=1)]
        found.append(np.stack([points, np.full(len(points), view)], axis=1))
    return np.concatenate(found).astype(np.int32)


def _lenses(model: str, parameters: tuple[float, ...], size: tuple[int, int]) -> list[tuple[str, Lens]]:
    """(face or "", lens) for each view of a photo; ValueError if there is none."""
    whole = Lens(model, size, parameters, np.eye(3), *size, (1.0, 1.0), (0.0, 0.0))
    focal = _middle_focal(whole)
    if model != PANORAMA:
        sides = _sides(whole)
        with np.errstate(invalid="ignore"):
            middles = [side[len(side) // 2, 2] for side in sides]
        if not _is_wide(model) or min(middles) >= np.cos(np.radians(MOST_DEGREES)):
            return [("", _single(whole, focal, sides))]
    return _faces(whole, focal)


def _middle_focal(lens: Lens) -> tuple[float, float]:
    """(fx, fy), pixels: the focal length close to the lens's axis."""
    middle, right, below = _project(lens, np.array([(0, 0, 1), (SHORT, 0, 1), (0, SHORT, 1)]))
    focal = (right[0] - middle[0]) / SHORT, (below[1] - middle[1]) / SHORT
    if not (np.isfinite(focal).all() and min(focal) > 0 and max(focal) < 1e3 * max(lens.size)):
        raise ValueError(f"{lens.model} has no valid focal length")
    return focal


def _faces(whole: Lens, focal: tuple[float, float]) -> list[tuple[str, Lens]]:
    """The faces of a cube that a wide lens or a panorama shows."""
    side = max(1, int(min(2 * max(focal), LARGEST * max(whole.size))))
    places = np.meshgrid(*2 * [(np.arange(SAMPLES) + 0.5) * side / SAMPLES])
    faces = [
        (
            face,
            replace(
                whole,
                rotation=np.array(rotation, np.float64),
                width=side,
                height=side,
                focal=(side / 2, side / 2),
                centre=(side / 2, side / 2),
            ),
        )
        for face, rotation in FACES.items()
    ]
    shown = [
        (face, lens)
        for face, lens in faces
        if np.isfinite(_photo_pixels(lens, places, _least_forward(lens))).mean() >= LEAST_COVERED
    ]
    if not shown or side < SMALLEST * min(whole.size):
        raise ValueError(f"{whole.model}: the parameters do not describe a lens")
    return shown


def _is_wide(model: str) -> bool:
    """Whether a camera model can see beyond 90 degrees from its axis."""
    return "FISHEYE" in model or model == "EUCM"


def _sides(lens: Lens) -> list[NDArray[np.float64]]:
    """Rays float64[SAMPLES + 1, 3] of the photo's left, right, top and bottom border, or nan."""
    width, height = lens.size
    along = np.linspace(0, 1, SAMPLES + 1)
    return [
        _rays(lens, np.stack([x * width, y * height], axis=1))
        for x, y in ((0 * along, along), (0 * along + 1, along), (along, 0 * along), (along, 0 * along + 1))
    ]


def _single(lens: Lens, focal: tuple[float, float], borders: list[NDArray[np.float64]]) -> Lens:
    """The lens with one pinhole camera, whose image is the largest rectangle without uncovered
    pixels or, where that would lose too much of the photo, the smallest that has all of it, within
    limits."""
    most = np.tan(np.radians(MOST_DEGREES))
    ends = [end[np.isfinite(end).all(axis=1)] for end in map(_tangents, borders)]
    if not all(map(len, ends)):
        raise ValueError(f"{lens.model}: the parameters do not describe a lens")
    left, right, top, bottom = ends
    inner = [left[:, 0].max(), top[:, 1].max(), right[:, 0].min(), bottom[:, 1].min()]
    every = np.concatenate(ends)
    outer = [*every.min(axis=0), *every.max(axis=0)]
    low_x, low_y, high_x, high_y = np.clip(inner if _lost(lens, inner) <= MOST_LOST else outer, -most, most).tolist()
    sides = np.multiply((high_x - low_x, high_y - low_y), focal)
    if not (sides > SMALLEST * np.array(lens.size)).all():
        raise ValueError(f"{lens.model}: the parameters do not describe a lens")
    width, height = (int(np.clip(round(side), 1, LARGEST * whole)) for side, whole in zip(sides, lens.size))
    fx, fy = width / (high_x - low_x), height / (high_y - low_y)
    return replace(lens, width=width, height=height, focal=(fx, fy), centre=(-low_x * fx, -low_y * fy))


def _tangents(rays: NDArray[np.float64]) -> NDArray[np.float64]:
    """x/z and y/z [N, 2] of rays; nan or infinite behind the camera."""
    with np.errstate(all="ignore"):
        return np.asarray(rays[:, :2] / np.where(rays[:, 2:] > 0, rays[:, 2:], np.nan))


def _lost(lens: Lens, inner: Sequence[float]) -> float:
    """The share of the photo's pixels that are outside of a rectangle of x/z and y/z."""
    places = (np.arange(SAMPLES) + 0.5) / SAMPLES
    x, y = np.meshgrid(places * lens.size[0], places * lens.size[1])
    found = _tangents(_rays(lens, np.stack([x.ravel(), y.ravel()], axis=1)))
    with np.errstate(invalid="ignore"):
        return 1 - float(((found >= inner[:2]) & (found <= inner[2:])).all(axis=1).mean())


def pixel_map(lens: Lens) -> NDArray[np.float32]:
    """Where the pixels of the undistorted photo lie in the stored one: float32[2, H, W], x and y in
    pixels of the lens's size, nan where it does not show them."""
    result = np.empty((2, lens.height, lens.width), np.float32)
    step = max(1, BAND_PIXELS // lens.width)
    x, least = np.arange(lens.width) + 0.5, _least_forward(lens)
    for top in range(0, lens.height, step):
        y = np.arange(top, min(top + step, lens.height)) + 0.5
        result[:, top : top + step] = _photo_pixels(lens, np.meshgrid(x, y), least)
    return result


def rays_of(lens: Lens, x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
    """float64[N, 3]: the points at depth 1 that pixels x, y [N] of the undistorted photo show, in
    the frame of the stored photo's camera."""
    return (
        np.stack([(x - lens.centre[0]) / lens.focal[0], (y - lens.centre[1]) / lens.focal[1], np.ones_like(x)], axis=-1)
        @ lens.rotation.T
    )


def _photo_pixels(lens: Lens, places: Sequence[NDArray[np.float64]], least: float) -> NDArray[np.float64]:
    """`pixel_map` at places x, y [n, W] each, of rays of `least` cosine to the axis or more."""
    x, y = places
    rays = rays_of(lens, x.ravel(), y.ravel())
    pixels = _project(lens, rays)
    width, height = lens.size
    with np.errstate(invalid="ignore"):
        # half a pixel for rounding, where the nearest pixel is used
        shown = ((pixels >= -0.5) & (pixels <= (width + 0.5, height + 0.5))).all(axis=1)
        if lens.model != PANORAMA:
            # a polynomial that folds back shows places beyond the photo's border a second time
            shown &= _outwards(lens, rays, pixels)
            lengths = np.linalg.norm(rays, axis=1)
            shown &= rays[:, 2] >= least * lengths
            if _is_wide(lens.model):  # beyond 90 degrees, rays may project where they do not belong
                along = (_rays(lens, pixels[shown]) * rays[shown]).sum(axis=1)
                shown[shown] = along > np.cos(MOST_TURN) * lengths[shown]
    pixels[~shown] = np.nan
    return pixels.T.reshape(2, *x.shape)


def _outwards(lens: Lens, rays: NDArray[np.float64], pixels: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Whether rays farther from the axis appear farther from the middle of the photo."""
    farther = rays * np.where(rays[:, 2:] > 0, (1 + STEP, 1 + STEP, 1), (1 - STEP, 1 - STEP, 1))
    middle = _project(lens, np.array([(0.0, 0.0, 1.0)]))
    outside: NDArray[np.bool_] = ((_project(lens, farther) - middle) ** 2).sum(axis=1) >= ((pixels - middle) ** 2).sum(
        axis=1
    )
    return outside


def _least_forward(lens: Lens) -> float:
    """The least cosine of the angle between the axis and the rays of the photo's border."""
    cosines = np.concatenate(_sides(lens))[:, 2]
    known = cosines[np.isfinite(cosines)]
    return float(known.min()) - STEP if len(known) else -1.0


def _project(lens: Lens, rays: NDArray[np.float64]) -> NDArray[np.float64]:
    """Pixels [N, 2] of the stored photo, of rays float64[N, 3] in its camera's frame."""
    pixels: NDArray[np.float64] = _camera(lens).img_from_cam(
        np.ascontiguousarray(rays, np.float64), check_cheirality=False
    )
    if not _is_wide(lens.model) and lens.model != PANORAMA:
        pixels[rays[:, 2] <= 0] = np.nan
    return pixels


def _rays(lens: Lens, pixels: NDArray[np.float64]) -> NDArray[np.float64]:
    """Unit rays [N, 3] of pixels of the stored photo; nan where they do not come back to these."""
    rays = np.array(_camera(lens).cam_ray_from_img(pixels), np.float64).reshape(-1, 3)
    with np.errstate(invalid="ignore"):
        back = np.abs(_project(lens, rays) - pixels).max(axis=1)
        rays[~(back < 0.01 * max(lens.size))] = np.nan
    return rays


def _camera(lens: Lens) -> Any:
    import pycolmap

    try:
        return pycolmap.Camera(model=lens.model, width=lens.size[0], height=lens.size[1], params=list(lens.parameters))
    except (ValueError, RuntimeError, KeyError) as error:
        raise ValueError(f"pycolmap {pycolmap.__version__} does not know {lens.model}; a newer one may") from error
