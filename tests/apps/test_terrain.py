"""The terrain of a made city whose ground and buildings are known, and of a map with a house."""

from functools import cache

import numpy as np
import pytest
import rasterio

from clsplat.apps.geotiff import Raster
from clsplat.apps.map_grid import TILE, MapGrid
from clsplat.apps.terrain import check_width, filled, terrain_of, write_terrain
from clsplat.errors import InputError
from clsplat.evaluation.run import Run
from tests.apps.test_map import no_pictures, run_of  # noqa: F401  (a fixture)
from tests.command_line import clsplat_
from tests.data import ground_model as made
from tools.synth.city import KINDS, UNIT_METRES, from_above, lay_out

PIXEL, WIDTH = 0.8, 40.0  # metres


@cache
def made_city():
    """x, heights, metres, and which places are of the ground, and of buildings."""
    city = lay_out((2, 2), 0, small=True)
    x, y = np.meshgrid(
        *(np.arange(-end * UNIT_METRES, end * UNIT_METRES, PIXEL) + PIXEL / 2 for end in city.extent + 5)
    )
    heights, solids = from_above(city, x / UNIT_METRES, y / UNIT_METRES)
    buildings = np.isin(solids, 1 + np.flatnonzero(city.kinds == KINDS.index("building")))
    return x, UNIT_METRES * heights, solids == 0, buildings


def surveyed(slope, noise=0.2):
    """Heights of a city on a slope, metres; those of its ground; and which are of the ground, and
    of buildings."""
    x, heights, is_ground, is_building = made_city()
    ground = slope * x + 250
    shown = ground + heights + np.random.default_rng(0).normal(0, noise, x.shape)
    return shown, ground, is_ground, is_building


def within(terrain, tolerance, shown):
    return np.abs(shown - terrain) <= tolerance


def test_a_city_is_taken_off_its_ground():
    shown, ground, is_ground, is_building = surveyed(0.08)
    terrain, tolerance = terrain_of(shown, PIXEL, WIDTH)
    error, found = np.abs(terrain - ground), within(terrain, tolerance, shown)
    assert np.median(error) < 0.15 and np.quantile(error, 0.95) < 0.4, "metres"
    assert np.sqrt(np.mean(error**2)) < 0.2
    assert found[is_ground].mean() > 0.98 and (~found[is_building]).mean() > 0.999


def test_what_is_wider_than_the_widest_object_stays():
    shown, ground, _, is_building = surveyed(0)
    terrain, _ = terrain_of(shown, PIXEL, 4.0)
    assert (terrain - ground)[is_building].mean() > 5


def test_a_pit_and_what_is_unknown_make_no_hole_in_the_terrain():
    heights = np.full((90, 80), 7.0)
    heights[30:50, 20:40] = 15  # a house
    heights[60:62, 60:62] = -60
    heights[31:34, 50:60] = np.nan
    terrain, _ = terrain_of(heights, 1.0, 36.0)
    assert np.abs(terrain - 7).max() < 1e-9


def test_a_house_beside_what_is_unknown_is_no_ground():
    """As if the map went on beneath it: a ramp from the roof down would be wider than any house."""
    heights = np.full((140, 120), 7.0)
    heights[30:60, 30:90] = 15
    heights[60:100, 30:90] = np.nan
    terrain, tolerance = terrain_of(heights, 1.0, 36.0)
    known = np.isfinite(heights)
    assert np.abs(terrain - 7)[known].max() < 0.05
    assert (within(terrain, tolerance, heights) == (heights == 7))[known].all()


def test_small_pits_of_a_model_do_not_pull_the_terrain_down():
    rng, heights = np.random.default_rng(0), np.full((150, 150), 7.0)
    for row, column in rng.integers(0, 146, (120, 2)):
        heights[row : row + 3, column : column + 3] = 7 - rng.uniform(1, 4)
    terrain, _ = terrain_of(heights, 1.0, 36.0)
    assert np.quantile(np.abs(terrain - 7), 0.95) < 0.3


def test_gaps_are_filled_linearly():
    y, x = np.mgrid[:40, :50].astype(float)
    plane, known = 3 * x - 2 * y, np.ones(x.shape, bool)
    known[5:30, 8:40] = False
    assert np.abs(filled(np.where(known, plane, np.nan), known) - plane).max() < 0.1
    known[:] = False
    known[4, 7] = True
    assert (filled(np.where(known, plane, np.nan), known) == plane[4, 7]).all()


def test_the_raster_has_the_surface_where_that_is_ground(tmp_path):
    """Several tiles, finer than the cells of the filter; a slope with a house across their border."""
    size = 3 * TILE // 2
    grid = MapGrid(np.eye(3), np.zeros(3), 0.0, 0.0, 0.1, size, size, 99.0)
    x = np.tile((np.arange(size) + 0.5) * 0.1, (size, 1))
    heights = 50 + 0.1 * x
    heights[470:560, 470:560] += 6
    heights[:30, :30] = np.nan
    surface, terrain = (
        Raster(tmp_path / name, grid, None, dict.fromkeys(("height", name)), np.nan) for name in ("spread", "ground")
    )
    surface.write((0, 0), np.stack([heights, heights], axis=-1))
    surface.finish({})
    share = write_terrain(surface, terrain, 18.0)
    terrain.finish({})
    result, ground = np.moveaxis(terrain.whole(0), -1, 0)
    assert np.isnan(result[:30, :30]).all() and np.isfinite(result[31:, 31:]).all()
    house = np.s_[475:555, 475:555]
    assert (ground[house] == 0).all() and ground[:400, 100:].all()
    assert np.abs(result - 50 - 0.1 * x)[house].max() < 0.15, "the slope beneath the house"
    assert np.array_equal(result[600:, 100:], heights.astype(np.float32)[600:, 100:])
    known = np.isfinite(heights).sum()
    assert abs(share - (known - 90 * 90) / known) < 0.01


def test_the_command(tmp_path, monkeypatch, no_pictures):  # noqa: F811
    monkeypatch.setattr(Run, "open", lambda path: run_of(path, made.scene()))
    result = clsplat_("map", "run", "-o", tmp_path / "map", "--resolution", 0.1, "--contours", 0, "--terrain", 10)
    assert result.exit_code == 0 and "of the surface is ground" in result.output, result.output
    with rasterio.open(tmp_path / "map" / "terrain.tif") as file:
        heights, ground = file.read()
        assert file.descriptions == ("height", "ground") and file.units == ("metre", None)
        assert file.crs.to_epsg() == 32633
    base = made.OFFSET[2] + made.UTM.offset[2]
    assert np.nanmax(np.abs(heights - base)) < 0.1 and 0.8 < np.nanmean(ground) < 0.96


def test_a_width_below_the_pixels_is_refused(tmp_path, monkeypatch):
    with pytest.raises(InputError, match="narrower than 4 pixels"):
        check_width(0.3, 0.1)
    monkeypatch.setattr(Run, "open", lambda path: run_of(path, made.scene()))
    result = clsplat_("map", "run", "-o", tmp_path / "map", "--resolution", 0.1, "--terrain", 0.2)
    assert result.exit_code == 2 and "--terrain 0.2" in result.output
    assert not (tmp_path / "map").exists()
