"""The map of a run: orthophoto, surface and terrain as GeoTIFF, contour lines and a picture, and a
statement of how exact it is."""

import json
import math
import warnings
from pathlib import Path
from shutil import rmtree
from tempfile import TemporaryDirectory
from typing import Any

import contourpy
import numpy as np
import scipy
from numpy.typing import NDArray

from clsplat.apps.geotiff import Raster, bounded_memory
from clsplat.apps.hillshade import NODATA, TAGS, write_hillshade
from clsplat.apps.map_files import (
    ASSETS,
    CONTOURS,
    FILES,
    ITEM,
    ORTHOPHOTO,
    PREVIEW,
    RECORD,
    REPORT,
    SHADING,
    SURFACE,
    TERRAIN,
    write_styles,
)
from clsplat.apps.map_grid import MapGrid, ground_resolution
from clsplat.apps.map_report import write_report
from clsplat.apps.orthophoto import Extent, MapPainter, extent_of
from clsplat.apps.stac import stac_item
from clsplat.apps.terrain import check_width, write_terrain
from clsplat.device import Device
from clsplat.errors import InputError
from clsplat.evaluation.run import Run
from clsplat.evaluation.survey import Photographs, photographs_of, survey_of, vertical_reference
from clsplat.georeference import AXES, CHECK, CONTROL
from clsplat.io.atomic import replacing
from clsplat.io.folders import make_folder
from clsplat.io.georeference.crs import WGS84, on_ground
from clsplat.io.records import write_object
from clsplat.report.figures.map_preview import USUAL, write_preview
from clsplat.report.page import as_utf8
from clsplat.scene import Scene
from clsplat.training.progress import SilentProgress

CONTOUR_SIDE = 3000  # pixels of the coarser raster that they are made from
PREVIEW_SIDE = 1400  # pixels, the longer side of each of its pictures
HEIGHTS = (0.01, 0.99)  # quantiles that the record has: single pixels may be far off
DEGREE_DIGITS = 8  # after the point: a millimetre
DIGITS = 9  # of heights
COLOURS = dict.fromkeys(("red", "green", "blue", "alpha"))  # bands, without a unit
HEIGHTS_OF, GROUND_OF = ("height", "spread"), ("height", "ground")
SCRATCH = ".drawing-"  # how the name of the temporary folder begins
MOST_HALVINGS = 9  # a tile is then one pixel

WINDOW, STEP = 13, 8  # samples of the local median along a side, and pixels between them
MARGIN = (WINDOW // 2 + 1) * STEP  # pixels around a tile that its windows need
LEAST_DEPTH = 10  # pixels: shallower pits are noise, which surfaces have everywhere
THICK = 0.5  # of a pit's depth: over less of it, and of LEAST_DEPTH, a true bottom's light spreads
LEAST_SURE = 0.1  # of the samples of a window: with fewer, no unsure height is kept
LINES, MOST_LINES = 15, 1000  # contour lines, about, unless the interval is given; and at most
ROUND = np.array([float(f"{digit}e{power}") for power in range(-6, 6) for digit in (1, 2, 5)])
SMOOTHING = 4.0  # pixels: noise of single pixels is no contour line
SHORTEST = 48  # points of a line; shorter ones are noise

Heights = NDArray[np.floating]  # [H, W], nan: unknown
ContourLine = tuple[float, NDArray[np.float64]]  # its height, and (column, row) [N, 2] along it


def write_map(
    run: Run,
    scene: Scene,
    grid: MapGrid,
    device: Device,
    folder: Path,
    *,
    interval: float | None = None,
    terrain: float | None = None,
    follow: bool = False,
    whole: Scene | None = None,
    progress: SilentProgress | None = None,
) -> dict[str, Any]:
    """Write the map of a run into a folder; the files of an earlier map are replaced or removed.

    Parameters
    ----------
    run, scene : finished, and its scene, whose georeference the map has.
    grid : of the map.
    device : an open device.
    folder : created if it is missing.
    interval : between contour lines, map units; None: a round number that suits; 0: none.
    terrain : the width of the widest object that is no ground, map units; None: no terrain.
    follow : whether the bounds become those of all that the map can show.
    whole : the scene at the size of its photos; None: `scene` has that.
    progress : is given what is done.

    Returns
    -------
    What RECORD holds.
    """
    progress, whole = progress or SilentProgress(), whole or scene
    photos = photographs_of(whole)
    crs = scene.georeference.crs if scene.georeference else None
    if terrain is not None:
        check_width(terrain, grid.resolution)
    make_folder(folder)
    for killed in folder.glob(SCRATCH + "*"):
        rmtree(killed, ignore_errors=True)
    with bounded_memory(), TemporaryDirectory(dir=folder, prefix=SCRATCH) as scratch:
        progress.phase("looking at the extent")
        extent = extent_of(device, run, scene, grid)
        if follow:
            grid = extent.around(grid)
        unit = "metre" if crs else "scene unit"
        statement = _stated(whole, photos)
        units = dict.fromkeys(HEIGHTS_OF, unit)
        colours = Raster(Path(scratch) / "colours", grid, crs, COLOURS, None)
        drawn, surface = (Raster(Path(scratch) / name, grid, crs, units, np.nan) for name in ("drawn", "surface"))
        _draw(run, scene, grid, extent, device, (colours, drawn), progress)
        progress.phase("leaving out pits")
        dropped = _copy_without_pits(colours, drawn, surface)
        progress.phase("making overviews")
        tags = {
            "TIFFTAG_SOFTWARE": "clsplat",
            **{
                name.upper(): value if isinstance(value, str) else json.dumps(value)
                for name, value in statement.items()
            },
        }
        for raster in (colours, surface):
            raster.finish(tags)
        level = surface.level(CONTOUR_SIDE)
        heights = surface.whole(level)[..., 0]
        if not np.isfinite(heights).any():
            raise InputError(
                f"{run.path}: everywhere on the map, the model is transparent or "
                "fewer than two photos show the place; train longer, or give other "
                "--bounds"
            )
        if interval is None:
            interval = _contour_interval(heights)
        if interval:
            progress.phase("drawing contour lines")
        lines = contour_lines(heights, interval)  # first of all: there may be too many of them
        rasters, ground = {ORTHOPHOTO: colours, SURFACE: surface}, dict[str, Any]()
        if terrain is not None:
            progress.phase("finding the ground")
            bare = Raster(Path(scratch) / "bare", grid, crs, dict(zip(GROUND_OF, (unit, None))), np.nan)
            ground["terrain"] = {"width": terrain, "ground": write_terrain(surface, bare, terrain)}
            bare.finish(tags)
            rasters[TERRAIN] = bare
        progress.phase("shading")
        for source in [name for name in SHADING if name in rasters]:
            shade = Raster(Path(scratch) / f"shade of {source}", grid, crs, {"hillshade": None}, NODATA)
            write_hillshade(rasters[source], shade)
            shade.finish(tags | TAGS)
            rasters[SHADING[source]] = shade
        progress.phase("writing GeoTIFF files")
        for name, raster in rasters.items():
            raster.save(folder / name)
        small = surface.level(PREVIEW_SIDE)
        short = "m" if crs else "scene units"
        files = [*rasters, PREVIEW, *write_styles(folder, rasters, small, short)]
        with replacing(folder / PREVIEW) as file:
            write_preview(
                file,
                colours.whole(small),
                surface.whole(small)[..., 0],
                [line * 2.0 ** (level - small) for _, line in lines],
                grid.resolution * 2**small,
                interval,
                unit,
            )
        if interval:
            _write_contours(folder / CONTOURS, lines, grid, level, crs)
            files.append(CONTOURS)
        known = heights[np.isfinite(heights)]
        record = {
            "crs": crs,
            "unit": unit,
            "resolution": grid.resolution,
            "columns": grid.columns,
            "rows": grid.rows,
            "bounds": grid.bounds,
            "heights": np.quantile(known, HEIGHTS).tolist(),
            "covered": float(len(known) / heights.size),
            "contour_interval": interval,
            "pits": dropped,
            **ground,
            **statement,
            "bands": {name: [band["name"] for band in raster.bands] for name, raster in rasters.items()},
            "axes": grid.axes.tolist(),
            "origin": grid.origin.tolist(),
            "files": [*files, REPORT, *[ITEM] * bool(crs and photos.period)],
        }
        progress.phase("writing the report")
        name = as_utf8(run.path.resolve().name)
        write_report(folder / REPORT, name, survey_of(whole), photos, rasters, small, record)
        if crs and photos.period:
            write_object(
                folder / ITEM,
                stac_item(
                    name, grid, photos.period, ASSETS, {file: raster.bands for file, raster in rasters.items()}, record
                ),
                indent=2,
            )
    for name in set(FILES) - {*record["files"], RECORD}:
        (folder / name).unlink(missing_ok=True)
    write_object(folder / RECORD, record, indent=2)
    return record


def _draw(
    run: Run,
    scene: Scene,
    grid: MapGrid,
    extent: Extent,
    device: Device,
    drawn: tuple[Raster, Raster],
    progress: SilentProgress,
) -> None:
    """Draw all tiles in which anything is known."""
    # gaussians smaller than a pixel would be drawn as large as one, and hide what is beside
    # them: a map coarser than the photos is the mean of finer pixels
    halvings = min(max(0, round(math.log2(grid.resolution / ground_resolution(scene)))), MOST_HALVINGS)
    finer = grid.finer(halvings)
    painter = MapPainter(device, run, finer, scene)
    # those of one tile of the file follow each other, as it is compressed anew at every return
    tiles = sorted(np.ndindex(finer.tiles[::-1]), key=lambda tile: (tile[0] >> halvings, tile[1] >> halvings))
    for done, (row, column) in enumerate(tiles, 1):
        inside = extent.inside(finer, column, row)[..., None]
        if not inside.any():
            continue
        progress.count("tile", done, len(tiles))
        colours, surface = painter.tile(column, row)
        masked = np.where(inside, colours, 0), np.where(inside, surface, np.float32(np.nan))
        for raster, pixels in zip(drawn, masked):
            raster.write((column, row), _coarser(pixels, 2**halvings))
    for raster in drawn:
        raster.close()


def _coarser(pixels: NDArray[Any], factor: int) -> NDArray[Any]:
    """The means of squares of so many pixels: of heights without nan, of colours by alpha."""
    side = len(pixels) // factor
    squares = pixels.reshape(side, factor, side, factor, -1).astype(np.float64)
    is_colour = pixels.dtype == np.uint8
    known = squares[..., 3:] > 0 if is_colour else ~np.isnan(squares)
    number = known.sum(axis=(1, 3))
    means = np.where(known, squares, 0).sum(axis=(1, 3)) / np.maximum(number, 1)
    if is_colour:
        means[..., 3:] = 255 * number / factor**2
    else:
        means[number == 0] = np.nan
    result: NDArray[Any] = (means + 0.5 * is_colour).astype(pixels.dtype)
    return result


def _copy_without_pits(colours: Raster, drawn: Raster, surface: Raster) -> int:
    """Copy the surface that was drawn; how many heights are left out."""
    dropped = 0
    own = np.s_[MARGIN:-MARGIN, MARGIN:-MARGIN]
    for y, x in np.ndindex(drawn.grid.tiles[::-1]):
        covered = colours.read((x, y))[..., 3] > 0
        heights = drawn.read((x, y), MARGIN)
        known = np.isfinite(heights[own][..., 0]) & ~_pits(heights[..., 0], heights[..., 1], drawn.grid.resolution)
        dropped += int((covered & ~known).sum())
        if known.any():
            surface.write((x, y), np.where(known[..., None], heights[own], np.nan))
    return dropped


def _pits(heights: Heights, spread: Heights, resolution: float) -> NDArray[np.bool_]:
    """bool[H, W]: which pixels of a tile [H + 2 MARGIN, W + 2 MARGIN] are pits, or unsure where
    hardly any height around is sure.

    Where the ground is thin, half of the light passes it and ends at stray gaussians far below: the
    median depth has a pit there. It differs from a true hole or a street between houses in where
    the first tenth of the light is held back: on the ground, not at the bottom.
    """
    least = LEAST_DEPTH * resolution
    sure = np.where(spread <= least, heights, np.nan)[STEP // 2 :: STEP, STEP // 2 :: STEP]
    windows = np.lib.stride_tricks.sliding_window_view(sure, (WINDOW, WINDOW))[1:-1, 1:-1]
    with warnings.catch_warnings():  # of windows in which nothing is sure
        warnings.simplefilter("ignore", RuntimeWarning)
        level = np.nanmedian(windows, axis=(-2, -1))
    level[np.isfinite(windows).mean(axis=(-2, -1)) < LEAST_SURE] = np.inf
    inner = np.s_[MARGIN : heights.shape[0] - MARGIN, MARGIN : heights.shape[1] - MARGIN]
    depth = np.kron(level, np.ones((STEP, STEP))) - heights[inner]
    found: NDArray[np.bool_] = (depth > least) & (spread[inner] > np.minimum(THICK * depth, least))
    return found


def _contour_interval(heights: Heights) -> float:
    """The number of ROUND that gives about LINES contour lines; 0 for level ground."""
    low, high = np.nanquantile(heights, USUAL)
    if not high > low:
        return 0.0
    return float(ROUND[np.abs(np.log(ROUND * LINES / (high - low))).argmin()])


def contour_lines(heights: Heights, interval: float) -> list[ContourLine]:
    """Contour lines of a surface; the centre of the first pixel is (0.5, 0.5).

    Parameters
    ----------
    heights : [H, W]; nan: unknown, where lines end.
    interval : between lines; heights that are multiples of it have one. 0: there are no lines. An
        InputError if there would be too many.
    """
    if interval <= 0 or min(heights.shape) < 2:
        return []
    low, high = np.nanquantile(heights, (0.001, 0.999))
    if high - low > MOST_LINES * interval:
        raise InputError(f"--contours {interval:g}: more than {MOST_LINES:,} lines; give a larger interval")
    known = ~np.isnan(heights)
    weight, total = (
        scipy.ndimage.gaussian_filter(values, SMOOTHING)
        for values in (known.astype(np.float64), np.where(known, heights, 0.0))
    )
    generator = contourpy.contour_generator(z=np.ma.masked_array(total / np.maximum(weight, 1e-9), mask=~known))
    return [
        (number * interval, np.asarray(line) + 0.5)
        for number in range(math.ceil(low / interval), math.floor(high / interval) + 1)
        for line in generator.lines(number * interval)
        if len(line) >= SHORTEST
    ]


def _write_contours(path: Path, lines: list[ContourLine], grid: MapGrid, level: int, crs: str | None) -> None:
    """Replace a GeoJSON file (RFC 7946); every line is a feature with the property `elevation`, in
    longitude and latitude, or the map's coordinates if the scene has no place on the earth."""
    size = grid.resolution * 2**level
    vertices = np.concatenate([np.empty((0, 2)), *(line for _, line in lines)])
    places = np.pad((grid.left, grid.top) + vertices * (size, -size), ((0, 0), (0, 1)))
    digits = DEGREE_DIGITS if crs else max(0, math.ceil(1 - math.log10(size)))
    places = np.round((on_ground(crs, WGS84, places) if crs else places)[:, :2], digits)
    ends = np.cumsum([len(line) for _, line in lines])
    features = [
        {
            "type": "Feature",
            "properties": {"elevation": round(height, DIGITS)},
            "geometry": {"type": "LineString", "coordinates": line.tolist()},
        }
        for (height, _), line in zip(lines, np.split(places, ends))
    ]
    with replacing(path) as file:
        file.write(json.dumps({"type": "FeatureCollection", "features": features}).encode())


def _stated(scene: Scene, photos: Photographs) -> dict[str, Any]:
    """What is known of a map's exactness, for RECORD: the ground sampling distance of the photos,
    the vertical reference, when the photos were taken, and the georeference with its residuals,
    metres."""
    result: dict[str, Any] = {
        "ground_sampling_distance": ground_resolution(scene),
        "vertical_reference": vertical_reference(scene.georeference),
    }
    if photos.period:
        result["taken"] = [each.isoformat() for each in photos.period]
    if place := scene.georeference:
        result["georeference"] = {
            "source": place.source,
            "residual": place.residual,
            "warnings": list(place.warnings),
            "residuals_rms": {
                role: {axis: error.rms for axis, error in errors.items()}
                for role in (CHECK, CONTROL)
                if (errors := place.errors(role))
            },
        }
    return result


def sentences(statement: dict[str, Any], unit: str) -> list[str]:
    """What `clsplat map` prints of it."""
    lines = [f"ground sampling distance of the photos {statement['ground_sampling_distance']:g} {unit}"]
    place = statement.get("georeference")
    if place:
        lines[0] += f"; heights: {statement['vertical_reference']}"
        lines.append(
            f"georeference: {place['source'] or 'unknown source'}, residual {place['residual']:.2f} m along the ground"
        )
        for role, axes in place["residuals_rms"].items():
            lines.append(f"{role} RMS: " + ", ".join(f"{axis} {axes[axis]:.2f} m" for axis in AXES if axis in axes))
        lines += [f"warning: {text}" for text in place["warnings"]]
    return lines
