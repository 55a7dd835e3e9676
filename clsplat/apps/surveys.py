"""Two surveys of one place: the later surface is moved onto the earlier one by what did not change,
and their difference tells what did."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from clsplat.apps.differences import DETECTION, check_same_system, heights_at, middles, nmad
from clsplat.apps.geotiff import VERTICAL, Raster, Surface, bounded_memory, read_surface
from clsplat.apps.qgis import STOPS, write_heights_style, write_ramp
from clsplat.errors import InputError
from clsplat.io.atomic import replacing
from clsplat.io.folders import make_folder
from clsplat.io.records import plain, write_object
from clsplat.report.figures import hex_colours
from clsplat.report.figures.difference import CHANGES, strongest, write_difference

ALIGNED, DIFFERENCE, PICTURE = "aligned.tif", "difference.tif", "difference.png"
RECORD, STYLES = "comparison.json", ("aligned.qml", "difference.qml")
FILES = ALIGNED, DIFFERENCE, PICTURE, RECORD, *STYLES
SLOPES = 0.05, 0.2, 1.0  # rise over run, between classes of slope: steep places are noisier
SMOOTHING = 8.0, 4.0, 2.0, 1.0  # pixels, from the first alignment to the last
TRIM = 3.0  # NMAD: beyond, a place has changed
MOST_STEPS = 12  # of each alignment
STILL = 0.005  # pixels: a step shorter than this is the last
LEAST_LIKENESS = 0.3  # correlation of the slopes of both: level ground has none but noise
LEAST_PLACES = 100  # that both surveys know, and of a class of slope
Heights = NDArray[np.float64]  # [H, W], nan: unknown


class Alignment(NamedTuple):
    """How a surface was moved.

    Attributes
    ----------
    shift : east, north and up, map units, that was added to its coordinates.
    horizontal : whether the ground has relief that shows the first two; else they are 0.
    difference : it minus the other, after that.
    noise : [H, W], the NMAD of the difference among places as steep.
    """

    shift: NDArray[np.float64]
    horizontal: bool
    difference: Heights
    noise: Heights


def align(first: Surface, second: Surface) -> Alignment:
    """Move a surface onto another one.

    A horizontal shift changes heights by slope: it is found, with the vertical one, by least
    squares over places of all slopes and aspects (Nuth & Kääb 2011, here linear in the shift, as
    walls have no finite tangent), which are weighted and trimmed among places as steep by the
    median absolute deviation, from smoothed surfaces to sharp ones.
    """
    check_same_system(first, second)
    x, y = middles(first.grid)
    pixel, shift = first.grid.resolution, np.zeros(3)
    for smoothing in SMOOTHING:
        fixed, moved = (replace(each, heights=_smooth(each.heights, smoothing)) for each in (first, second))
        for _ in range(MOST_STEPS):
            heights = heights_at(moved, x - shift[0], y - shift[1]) + shift[2]
            step = _step(fixed.heights, heights, pixel)
            shift += step
            if np.abs(step).max() < STILL * pixel:
                break
    horizontal = _alike(fixed.heights, heights, pixel)
    if not horizontal:
        shift = np.array([0, 0, np.nanmedian(first.heights - heights_at(second, x, y))])
    heights = heights_at(second, x - shift[0], y - shift[1]) + shift[2]
    difference = heights - first.heights
    steepness = _classes(_slopes(first.heights, heights, pixel))
    noise = np.full(difference.shape, nmad(difference))
    for kind in np.unique(steepness):
        if np.isfinite(difference[steepness == kind]).sum() >= LEAST_PLACES:
            noise[steepness == kind] = nmad(difference[steepness == kind])
    return Alignment(shift, horizontal, difference, noise)


def _step(fixed: Heights, moved: Heights, pixel: float) -> NDArray[np.float64]:
    """The shift, east, north and up, that brings a surface nearer to another one."""
    east, north = _slopes(fixed, moved, pixel)
    away = fixed - moved
    usable = np.isfinite(away) & np.isfinite(east) & np.isfinite(north)
    if usable.sum() < LEAST_PLACES:
        raise InputError(
            "the surveys share hardly any known place; give surveys of one place, in "
            "coordinates that differ by less than its size"
        )
    weights, steepness = np.zeros(away.shape), _classes((east, north))
    for kind in np.unique(steepness[usable]):
        places = usable & (steepness == kind)
        if places.sum() < LEAST_PLACES:
            continue
        spread = nmad(away[places]) + 1e-9 * pixel
        kept = np.abs(away - np.median(away[places])) <= TRIM * spread
        weights[places & kept] = 1 / spread
    rows = weights > 0
    matrix = np.column_stack([-east[rows], -north[rows], np.ones(rows.sum())])
    # a plane has no place: without a slope the shortest shift is none
    found = np.linalg.lstsq(matrix * weights[rows][:, None], (away * weights)[rows], rcond=1e-6)
    return np.asarray(found[0], np.float64)


def _alike(first: Heights, second: Heights, pixel: float) -> bool:
    """Whether two surfaces have the same relief."""
    own, other = (np.stack(_slopes(each, each, pixel)) for each in (first, second))
    same, first_square, second_square = (
        np.nansum(np.where(np.isfinite(own * other), product, 0)) for product in (own * other, own**2, other**2)
    )
    return bool(same > LEAST_LIKENESS * np.sqrt(first_square * second_square))


def _slopes(first: Heights, second: Heights, pixel: float) -> tuple[Heights, Heights]:
    """The mean slopes of two surfaces to the east and north."""
    mean = (first + second) / 2
    east: Heights = np.gradient(mean, pixel, axis=1)
    south: Heights = np.gradient(mean, pixel, axis=0)
    return east, -south


def _classes(slopes: tuple[Heights, Heights]) -> NDArray[np.integer]:
    """The class of each place by SLOPES; len(SLOPES) also where the slope is unknown."""
    return np.digitize(np.hypot(*slopes), SLOPES)


def _smooth(heights: Heights, pixels: float) -> Heights:
    """Heights without detail of single pixels; unknown ones stay unknown."""
    known = np.isfinite(heights)
    weight, total = (
        scipy.ndimage.gaussian_filter(values, pixels)
        for values in (known.astype(np.float64), np.where(known, heights, 0.0))
    )
    return np.where(known, total / np.maximum(weight, 1e-9), np.nan)


def write_comparison(first: Path, second: Path, folder: Path, names: tuple[str, str] | None = None) -> dict[str, Any]:
    """Align a later surface to an earlier one, and write FILES into a folder.

    Parameters
    ----------
    first, second : surfaces as GeoTIFF, of the earlier and the later survey.
    folder : created if it is missing.
    names : of the two in RECORD; None: their paths.

    Returns
    -------
    What RECORD holds.
    """
    early, late = read_surface(first), read_surface(second)
    try:
        alignment = align(early, late)
    except InputError as error:
        raise error if str(second) in str(error) else InputError(f"{second}: {error}") from None
    difference, pixel = alignment.difference, early.grid.resolution
    sure = np.abs(difference) > DETECTION * alignment.noise
    # a lone pixel is noise: what changed is wider than two
    grown, gone = (
        scipy.ndimage.binary_opening(sure & side, np.ones((3, 3))) for side in (difference > 0, difference < 0)
    )
    steepness = _classes(_slopes(early.heights, early.heights + difference, pixel))
    stable = np.isfinite(difference) & ~grown & ~gone & (steepness < len(SLOPES))
    noise = nmad(difference[stable])
    record = plain(
        {
            **dict(zip(("before", "after"), names or (str(first), str(second)))),
            "crs": early.crs,
            "unit": early.unit,
            "pixel": pixel,
            "shift": dict(zip(("east", "north", "up"), alignment.shift)),
            "horizontal_shift_found": alignment.horizontal,
            "compared": np.isfinite(difference).mean(),
            "stable": stable.sum() * pixel**2,
            "noise": noise,
            "level_of_detection": DETECTION * noise,
            "fill": difference[grown].sum() * pixel**2,
            "cut": -difference[gone].sum() * pixel**2,
            "changed": (grown | gone).sum() * pixel**2,
        }
    )
    make_folder(folder)
    _write(folder / ALIGNED, early, {"height": early.unit}, early.heights + difference)
    _write(
        folder / DIFFERENCE,
        early,
        {"difference": early.unit, "noise": early.unit},
        difference,
        np.where(np.isfinite(difference), alignment.noise, np.nan),
    )
    changed = np.where(grown | gone, difference, np.nan)
    with replacing(folder / PICTURE) as file:
        write_difference(file, early.heights, changed, pixel, DETECTION * noise, early.unit)
    write_heights_style(folder / ALIGNED, early.heights + difference, early.unit)
    most = strongest(changed, DETECTION * noise)
    write_ramp(folder / DIFFERENCE, hex_colours(CHANGES, STOPS), -most, most, early.unit)
    write_object(folder / RECORD, record, indent=2)
    return record  # type: ignore[no-any-return]


def _write(path: Path, like: Surface, bands: dict[str, str | None], *heights: Heights) -> None:
    """Replace a file by a COG with the grid of a surface."""
    with bounded_memory(), TemporaryDirectory(dir=path.parent) as scratch:
        raster = Raster(Path(scratch) / "raw", like.grid, like.crs, bands, np.nan)
        raster.write((0, 0), np.stack(heights, axis=-1))
        tags = {VERTICAL: like.vertical} if "height" in bands else {}
        raster.finish({"TIFFTAG_SOFTWARE": "clsplat", **tags})
        raster.save(path)
