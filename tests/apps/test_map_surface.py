"""What a map claims: its files' layout, coordinate systems, pits, holes and extent; and words of
`clsplat map` that are refused in one line."""

import dataclasses
import json
from types import SimpleNamespace

import numpy as np
import pyproj
import pytest
import rasterio

from clsplat.apps import map as map_module
from clsplat.apps.geotiff import Raster
from clsplat.apps.map import contour_lines, write_map
from clsplat.apps.map_grid import TILE, MapGrid, map_grid
from clsplat.evaluation.run import Run
from clsplat.gaussians import Gaussians
from clsplat.georeference import Residual
from clsplat.io.georeference.crs import normal_crs, scene_crs
from clsplat.options import TrainOptions
from tests.apps.test_map import no_pictures, rasters, run_of  # noqa: F401  (a fixture)
from tests.command_line import clsplat_
from tests.data import ground_model as made

CODELESS = {
    "compound": "EPSG:32633+5773",
    "towgs84": "+proj=tmerc +lat_0=0 +lon_0=15 +k=1 +x_0=5500000 +ellps=bessel "
    "+towgs84=598.1,73.7,418.2,0.202,0.045,-2.455,6.7",
}


@pytest.mark.parametrize("text", CODELESS.values(), ids=CODELESS)
def test_a_crs_without_a_code_is_read_back_equal(tmp_path, text):
    crs = scene_crs(text)
    grid = MapGrid(np.eye(3), np.zeros(3), 5e5, 5.7e6, 1.0, 8, 4, 9.0)
    raster = Raster(tmp_path / "raw", grid, crs, {"height": "metre", "spread": "metre"}, np.nan)
    raster.write((0, 0), np.ones((TILE, TILE, 2)))
    raster.finish({})
    raster.save(tmp_path / "a.tif")
    with rasterio.open(tmp_path / "a.tif") as file:
        assert file.crs == rasterio.CRS.from_user_input(crs)
        assert pyproj.CRS(file.crs.to_wkt()).is_compound == pyproj.CRS(crs).is_compound


def with_holes():
    """The made-up ground with a true hole of 10 m depth and 5 m width, whose bottom is opaque, and
    a pit: ground so thin that most of the light ends at a stray gaussian 30 m below."""
    model = made.model()
    x, y, _ = model.positions.T
    hole = (abs(x + 7) < 2.5) & (abs(y - 6) < 2.5)
    model.positions[hole, 2] = -10
    thin = (abs(x - 7) < 1.5) & (abs(y + 7) < 1.5)
    model.opacity_logits[thin] = -2.2
    stray = Gaussians(
        {
            **{name: rows[:1].copy() for name, rows in model.rows.items()},
            "positions": np.array([[7, -7, -30]], np.float32),
            "log_scales": np.log(np.array([[3, 3, 0.1]], np.float32)),
        },
        0,
        made.OFFSET,
    )
    rows = {name: np.concatenate([values, stray.rows[name]]) for name, values in model.rows.items()}
    return Gaussians(rows, 0, made.OFFSET)


def test_a_pit_is_left_out_and_a_true_hole_stays(item_device, tmp_path, no_pictures):  # noqa: F811
    model, scene = with_holes(), made.scene(None)
    points = model.positions[model.positions[:, 2] > -20].astype(float)
    scene = dataclasses.replace(scene, points=points, colours=np.zeros((len(points), 3), np.uint8))
    grid = dataclasses.replace(map_grid(scene, 0.1), floor=-np.inf)  # the local rule alone
    run = SimpleNamespace(path=tmp_path, finished_model=model, options=TrainOptions(), georeference=None)
    record = write_map(run, scene, grid, item_device, tmp_path, interval=0)
    colours, heights = rasters(tmp_path)

    def at(x, y):
        column, row = np.floor(grid.pixels(made.OFFSET[None] + (x, y, 0))).astype(int)[0]
        return np.s_[row - 5 : row + 6, column - 5 : column + 6]

    assert abs(heights[at(-7, 6)] - (7 - 10)).max() < 0.1, "the bottom of the hole"
    assert np.isnan(heights[at(7, -7)]).all() and record["pits"] > 400
    assert (colours[at(7, -7)][..., 3] == 255).all(), "its colour stays"
    assert abs(heights[at(0, 0)] - 9).max() < 0.01 and abs(heights[at(0, -8)] - 7).max() < 0.01


@pytest.mark.slow
def test_the_extent_is_that_of_all_that_is_covered(item_device, tmp_path):
    """The sparse points lie in one half; nothing is cut, and little is empty."""
    scene = made.scene(None)
    kept = scene.points[:, 0] < 3
    half = dataclasses.replace(scene, points=scene.points[kept], colours=scene.colours[kept])
    record = write_map(run_of(tmp_path, half), half, map_grid(half, 0.1), item_device, tmp_path, follow=True)
    left, bottom, right, top = record["bounds"]
    middle = made.OFFSET[:2]
    assert abs(np.array([left, bottom, right, top]) - [*(middle - 12), *(middle + 12)]).max() < 1
    assert record["covered"] > 0.9 and (rasters(tmp_path)[0][..., 3] == 0).any(axis=1).all()


def test_contour_lines_lie_where_a_slope_has_their_height():
    heights = np.tile(np.arange(60) + 0.5, (50, 1))  # at the centre of a column, its place
    lines = contour_lines(heights, 10.0)
    assert [height for height, _ in lines] == [10, 20, 30, 40, 50]
    for height, line in lines:
        assert np.abs(line[:, 0] - height).max() < 0.05 and np.ptp(line[:, 1]) > 45


@pytest.mark.slow
def test_the_preview_has_the_lines_of_the_file(item_device, tmp_path, monkeypatch):
    """Of a coarser picture: lines are in its pixels."""
    shown = {}

    def write(file, colours, heights, lines, size, interval, unit):
        shown.update(shape=heights.shape, lines=lines, size=size)

    monkeypatch.setattr(map_module, "write_preview", write)
    monkeypatch.setattr(map_module, "PREVIEW_SIDE", 350)
    scene = made.scene(None)
    grid = map_grid(scene, 0.04)
    write_map(run_of(tmp_path, scene), scene, grid, item_device, tmp_path, interval=1.0)
    assert max(shown["shape"]) <= 350 and shown["size"] == 0.08
    house = grid.pixels(made.OFFSET[None])[0] * grid.resolution / shown["size"]
    middles = [(line.min(axis=0) + line.max(axis=0)) / 2 for line in shown["lines"]]
    assert min(np.abs(middle - house).max() for middle in middles) < 2
    assert (np.concatenate(shown["lines"]).max(axis=0) <= shown["shape"][::-1]).all()


COMPOUND = "EPSG:32633+5773"
MIDDLE = made.OFFSET + made.UTM.offset
NEAR = tuple(str(side) for side in (MIDDLE[0] - 4, MIDDLE[1] - 4, MIDDLE[0] + 4, MIDDLE[1] + 4))
REFUSED = [
    (["--resolution", "1e5"], "larger than the map"),
    (["--resolution", "1e-300"], "pixels along a side"),
    (["--resolution", "0"], "range"),
    (["--resolution", "nan"], "not a finite number"),
    (["--bounds", "nan", "0", "1", "1"], "--bounds"),
    (["--bounds", "0", "5", "1", "1"], "--bounds"),
    (["--bounds", "-1e300", "-1e300", "1e300", "1e300"], "pixels along a side"),
    pytest.param(["--bounds", "0", "0", "10", "10", "--resolution", "1"], "other --bounds", marks=pytest.mark.slow),
    pytest.param(
        ["--contours", "1e-300", "--resolution", "1"], "larger interval", marks=pytest.mark.slow
    ),  # after drawing
]


@pytest.fixture
def mapped(tmp_path, monkeypatch):
    """A function of words, and of the georeference of the scene."""

    def call(words, place=made.UTM):
        monkeypatch.setattr(Run, "open", lambda path: run_of(path, made.scene(place)))
        folder = tmp_path / "map"
        return folder, clsplat_("map", "run", "-o", folder, *words)

    return call


@pytest.mark.parametrize(
    "words, message", REFUSED, ids=lambda value: " ".join(value) if isinstance(value, list) else ""
)
def test_refused_in_one_line(mapped, words, message):
    folder, result = mapped(words)
    assert result.exit_code == 2 and message in result.output, result.output
    line = result.output.strip().splitlines()[-1]
    assert line.startswith(("error: ", "Error: ")) and len(line) < 400, line
    assert not folder.exists() or not any(folder.iterdir())


@pytest.mark.slow
def test_all_that_a_georeference_holds_is_told(mapped):
    known = dataclasses.replace(
        made.UTM,
        crs=normal_crs(COMPOUND),
        vertical="EGM96 height (EPSG:5773)",
        warnings=("the residual is 9 % of the flight's size: check the GPS",),
        residuals=tuple(Residual(str(sign), "check", sign * 0.25, 0.25, None) for sign in (-1, 1)),
    )
    folder, result = mapped(["--resolution", "0.5", "--bounds", *NEAR], known)
    assert result.exit_code == 0, result.output
    for words in (
        "heights: EGM96 height",
        "residual 0.10 m",
        "warning: the residual is 9 %",
        "check RMS: east 0.25 m, north 0.25 m",
    ):
        assert words in result.output
    record = json.loads((folder / "map.json").read_text())
    assert record["georeference"]["residuals_rms"] == {"check": {"east": 0.25, "north": 0.25}}
    with rasterio.open(folder / "surface.tif") as file:
        assert file.shape == (record["rows"], record["columns"]) == (16, 16)
        assert file.tags()["VERTICAL_REFERENCE"].startswith("EGM96 height")
        assert file.crs == rasterio.CRS.from_user_input(COMPOUND)
        assert abs(np.nanmax(file.read(1)) - MIDDLE[2] - made.ROOF) < 0.1
