"""Maps of a made-up house on level ground, whose every pixel is known."""

import dataclasses
import json
import subprocess
import sys
from types import SimpleNamespace

import numpy as np
import pytest
import rasterio

from clsplat.apps import map as map_module
from clsplat.apps.map import write_map
from clsplat.apps.map_grid import ground_resolution, map_grid
from clsplat.errors import InputError
from clsplat.evaluation.run import Run
from clsplat.io.georeference.crs import on_ground
from clsplat.options import TrainOptions
from tests.command_line import clsplat_
from tests.data import ground_model as made

FILES = {
    "orthophoto.tif",
    "surface.tif",
    "surface.qml",
    "hillshade.tif",
    "hillshade.qml",
    "contours.geojson",
    "preview.png",
    "survey.pdf",
    "map.json",
}


def run_of(path, scene):
    """What a map needs of a run."""
    return SimpleNamespace(
        path=path,
        finished_model=made.model(),
        options=TrainOptions(),
        scene=lambda _=None, whole=False: scene,
        as_trained=lambda whole: whole,
        georeference=scene.georeference,
        up=scene.up,
    )


def drawn(device, folder, resolution=0.05, georeference=made.UTM, bounds=None, **options):
    scene = made.scene(georeference)
    grid = map_grid(scene, resolution, bounds)
    record = write_map(run_of(folder, scene), scene, grid, device, folder, **options)
    return grid, record, *rasters(folder)


def rasters(folder):
    """Colours [H, W, 4] and heights [H, W] of a map."""
    with rasterio.open(folder / "orthophoto.tif") as colours, rasterio.open(folder / "surface.tif") as surface:
        return np.moveaxis(colours.read(), 0, -1), surface.read(1)


@pytest.fixture
def no_pictures(monkeypatch):
    """Previews and reports take most of a map's time: those of `house` alone are drawn."""
    monkeypatch.setattr(map_module, "write_preview", lambda file, *_: file.write(b""))
    monkeypatch.setattr(map_module, "write_report", lambda path, *_: path.touch())


def corner_pixels(pixels):
    """The first and last column and row [2, 2] of blue pixels."""
    rows, columns = np.nonzero((pixels[..., 2] > pixels[..., 0]) & (pixels[..., 3] > 0))
    return np.array([[columns.min(), rows.min()], [columns.max() + 1, rows.max() + 1]])


@pytest.fixture(scope="module")
def house(item_device, tmp_path_factory):
    folder = tmp_path_factory.mktemp("map")
    return folder, *drawn(item_device, folder)


def test_colours_heights_and_places(house):
    folder, grid, record, colours, heights = house
    assert {path.name for path in folder.iterdir()} == FILES
    assert colours.shape == (grid.rows, grid.columns, 4) and heights.shape == colours.shape[:2]
    base = made.OFFSET[2] + made.UTM.offset[2]
    for place, height, colour in (((0, 0), made.ROOF, made.ROOF_BLUE), ((8, -7), 0, made.GROUND_RED)):
        at = np.floor(grid.pixels(made.OFFSET[None] + made.UTM.offset + (*place, 0))).astype(int)
        column, row = at[0]
        assert abs(heights[row, column] - base - height) < 2e-3
        assert abs(colours[row, column, :3] - np.multiply(colour, 255)).max() <= 4
        assert colours[row, column, 3] == 255
    # straight from above the house is as large as its roof, and where it is: walls do not show
    corners = grid.pixels(
        np.array([[-1, 1], [1, -1]]) * (made.HOUSE + 1.4 * made.SPACING) + (made.OFFSET + made.UTM.offset)[:2]
    )  # the edge of gaussians is soft
    assert abs(corner_pixels(colours) - corners).max() <= 1


def test_tags_place_it_on_the_earth(house):
    folder, grid, *_ = house
    for name, bands, unit in (
        ("orthophoto.tif", ("red", "green", "blue", "alpha"), None),
        ("surface.tif", ("height", "spread"), "metre"),
    ):
        with rasterio.open(folder / name) as file:
            assert file.crs.to_epsg() == 32633 and np.allclose(file.bounds, grid.bounds)
            assert file.tags(ns="IMAGE_STRUCTURE")["LAYOUT"] == "COG"
            assert file.descriptions == bands and set(file.units) == {unit}
            assert file.profile["tiled"] and file.compression.name == "deflate"
            tags = file.tags()
            assert json.loads(tags["GEOREFERENCE"])["residual"] == made.UTM.residual
            assert float(tags["GROUND_SAMPLING_DISTANCE"]) == ground_resolution(made.scene())
            assert tags["VERTICAL_REFERENCE"] == "unknown: the vertical system of the scene"


def test_contour_lines_surround_the_house_in_degrees(house):
    folder, grid, record, *_ = house
    lines = json.loads((folder / "contours.geojson").read_text())["features"]
    base = made.OFFSET[2] + made.UTM.offset[2]
    assert lines and all(base < line["properties"]["elevation"] < base + made.ROOF for line in lines)
    middle = (made.OFFSET + made.UTM.offset)[:2]
    for line in lines:
        places = [[*place, 0] for place in line["geometry"]["coordinates"]]
        away = on_ground("EPSG:4326", made.UTM.crs, places)[:, :2] - middle
        assert abs(abs(away).max(axis=1) - made.HOUSE).max() < 0.9


@pytest.mark.slow
def test_tiles_and_overviews_continue(item_device, tmp_path):
    """A map of several tiles shows what one of a single tile does, and passes the validator of
    cloud-optimised GeoTIFF: a strip from west to east, across the edge of the house."""
    left, bottom, *_ = corner = (made.OFFSET + made.UTM.offset)[:2] - (12, -1)
    grid, record, colours, heights = drawn(
        item_device, tmp_path, 0.02, bounds=(*corner, left + 24, bottom + 6), terrain=7.0
    )
    assert max(grid.tiles) > 2
    heights = heights - made.UTM.offset[2]
    known = ~np.isnan(heights)
    steps = abs(np.diff(np.where(known, heights, 7.0), axis=1)).max(axis=0)
    assert steps[511] < 2.1 and known[5:-5, 500:524].mean() > 0.97  # the rim of the roof
    ground = heights[20:100]
    assert abs(ground - 7).max() < 5e-3
    with rasterio.open(tmp_path / "surface.tif") as file:
        assert file.overviews(1) == [2, 4]
    with rasterio.open(tmp_path / "surface.tif", overview_level=0) as file:
        half = file.read(1) - made.UTM.offset[2]
    assert np.allclose(half[10:50], 7, atol=5e-3)
    cogeo = pytest.importorskip("rio_cogeo.cogeo", reason="rio-cogeo is not installed (extra test)")
    for name in record["bands"]:
        assert cogeo.cog_validate(tmp_path / name, quiet=True) == (True, [], []), name
        with rasterio.open(tmp_path / name) as file:
            assert file.overviews(1), name
            plain = file.profile | {"driver": "GTiff", "tiled": False, "copy_src_overviews": False}
            with rasterio.open(tmp_path / "plain.tif", "w", **plain) as other:
                other.write(file.read())
    assert not cogeo.cog_validate(tmp_path / "plain.tif", quiet=True)[0]


@pytest.mark.slow
def test_where_nothing_is_known(item_device, tmp_path):
    """Beyond the model there are holes; where one photo alone looks, nothing is claimed."""
    scene = made.scene(None)
    bounds = (80.0, -70.0, 120.0, -30.0)
    grid = map_grid(scene, 0.1, bounds)
    record = write_map(run_of(tmp_path, scene), scene, grid, item_device, tmp_path)
    colours, heights = rasters(tmp_path)
    assert record["crs"] is None
    assert (colours[:70, :70, 3] == 0).all() and np.isnan(heights[:70, :70]).all()
    assert np.array_equal(np.isnan(heights), colours[..., 3] == 0)
    assert not (colours[..., :3][colours[..., 3] == 0]).any()
    alone = dataclasses.replace(scene, views=scene.views[:1])
    with pytest.raises(InputError, match="--bounds"):
        write_map(run_of(tmp_path, alone), alone, grid, item_device, tmp_path / "one")
    assert not any((tmp_path / "one").iterdir())


def test_the_grid_follows_the_photos():
    scene = made.scene(None, width=400)
    assert abs(ground_resolution(scene) - 20 / scene.views[0].camera.focal[0]) < 2e-3
    tilted = made.scene(None, up=(0, np.sin(0.3), np.cos(0.3)))
    axes = map_grid(tilted).axes
    assert np.allclose(axes @ axes.T, np.eye(3)) and np.linalg.det(axes) > 0
    assert np.allclose(axes[2], tilted.up)
    up = np.array([0.002, -0.01, 1]) / np.linalg.norm([0.002, -0.01, 1])
    axes = map_grid(made.scene(None, up=up)).axes  # the estimate of a scene whose z points up
    assert np.allclose(axes[2], up) and np.allclose(axes @ axes.T, np.eye(3))
    assert np.linalg.det(axes) > 0 and abs(axes[[0, 1], [1, 0]]).max() < 1e-4
    assert np.array_equal(map_grid(scene).axes, np.eye(3))
    with pytest.raises(InputError, match="coarser resolution"):
        map_grid(scene, 1e-6)


def test_the_command(tmp_path, monkeypatch, no_pictures):
    monkeypatch.setattr(Run, "open", lambda path: run_of(path, made.scene(None)))
    words = "map", "run", "-o", tmp_path / "map", "--resolution", 0.1
    result = clsplat_(*words)
    assert result.exit_code == 0 and "heights 7.00 to 9.00" in result.output, result.output
    assert {path.name for path in (tmp_path / "map").iterdir()} == FILES
    again = clsplat_(*words)
    assert again.exit_code == 2 and "--overwrite" in again.output
    (tmp_path / "map" / "mine.txt").write_text("mine")
    again = clsplat_(*words, "--overwrite", "--contours", 0)
    assert again.exit_code == 0, again.output
    left = {path.name for path in (tmp_path / "map").iterdir()}
    assert left == FILES - {"contours.geojson"} | {"mine.txt"}, "no lines of the earlier map"


LIMIT_MIB = 768  # 600 are taken; the two rasters alone are 288
PROGRAM = """
import sys
from pathlib import Path
from clsplat.cli.progress import Progress
from clsplat.device import choose_device
from clsplat.apps.map import write_map
from clsplat.apps.map_grid import map_grid
from tests.data import ground_model as made
from tests.apps.test_map import run_of

scene, folder = made.scene(None), Path(sys.argv[1])
grid = map_grid(scene, 2.99 * made.SIDE / int(sys.argv[2]) * 2 / 3)
assert min(grid.columns, grid.rows) > 0.98 * int(sys.argv[2])
write_map(run_of(folder, scene), scene, grid, choose_device("auto"), folder)
# getrusage would count the peak of the process that started this one as well
status = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines())
print(float(status["VmHWM"].split()[0]) / 1024)
"""


@pytest.mark.nightly
def test_the_memory_of_a_large_map_does_not_grow_with_it(tmp_path):
    for side in (200, 6000):  # the first compiles the kernels, which some compilers need more for
        folder = tmp_path / str(side)
        folder.mkdir()
        done = subprocess.run(
            [sys.executable, "-c", PROGRAM, str(folder), str(side)],
            capture_output=True,
            text=True,
            timeout=1800,
            check=False,
        )
        assert done.returncode == 0, done.stderr
    assert float(done.stdout) < LIMIT_MIB
    assert (folder / "orthophoto.tif").stat().st_size < 200e6
