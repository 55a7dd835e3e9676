"""What stands beside the rasters of a map: hillshade, styles of QGIS, the item of a catalogue and
the report of the survey."""

import json
from dataclasses import replace
from datetime import datetime, timedelta, timezone
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest
import rasterio

from clsplat.apps import map as map_module
from clsplat.apps import map_report
from clsplat.apps.geotiff import Raster
from clsplat.apps.hillshade import NODATA, hillshade, write_hillshade
from clsplat.apps.map_files import ASSETS
from clsplat.apps.map_grid import TILE, MapGrid
from clsplat.apps.qgis import write_heights_style
from clsplat.apps.stac import stac_item
from clsplat.evaluation.survey import Photographs, photographs_of, survey_of
from clsplat.georeference import CHECK, Residual
from clsplat.report.figures.survey import write_pages
from clsplat.scene import View
from tests.apps.test_map import drawn
from tests.data import ground_model as made
from tests.io.photos.test_metadata import CLOCK, UTC, photo

GRID = MapGrid(np.eye(3), np.zeros(3), 4e5, 5.7e6, 0.5, 700, 300, 99.0)
FIRST, LAST = datetime(2024, 6, 1, 10, 0, 5), datetime(2024, 6, 1, 10, 20)


def stops(path):
    """The values, colours and labels of a style."""
    items = ElementTree.parse(path).getroot().findall(".//colorrampshader/item")
    return [[item.get(key) for item in items] for key in ("value", "color", "label")]


@pytest.mark.parametrize(
    "east, north, light",
    [
        (0, 0, 1 + 254 * np.sin(np.pi / 4)),
        (1, -1, 1 + 254 * (2**-0.5 + 1) / 3**0.5),
        (-1, 1, 1),
        (1, 1, 1 + 254 * (2**-0.5) / 3**0.5),
    ],
)
def test_the_sun_stands_in_the_north_west(east, north, light):
    """A slope that falls to the north-west is bright, one that falls to the south-east dark."""
    row, column = np.mgrid[:9, :9] * 0.5
    heights = 40 + east * column - north * row
    assert np.abs(hillshade(heights, 0.5)[1:-1, 1:-1] - light).max() <= 1


def test_only_what_is_known_is_shaded_and_tiles_continue(tmp_path):
    row, column = np.mgrid[: GRID.rows, : GRID.columns]
    heights = 5 * np.sin(column / 9) * np.cos(row / 7)
    heights[100:150, 480:540] = np.nan
    surface, shade = (
        Raster(tmp_path / name, GRID, "EPSG:32633", {name: None}, nodata)
        for name, nodata in (("height", np.nan), ("hillshade", NODATA))
    )
    padded = np.full((TILE, 2 * TILE), np.nan)
    padded[: GRID.rows, : GRID.columns] = heights
    for tile in range(2):
        surface.write((tile, 0), padded[:, TILE * tile : TILE * (tile + 1), None])
    surface.finish({})
    write_hillshade(surface, shade)
    shade.finish({})
    found = shade.whole(0)[..., 0]
    assert np.array_equal(found == NODATA, np.isnan(heights))
    whole = hillshade(heights, 0.5).astype(int)
    assert np.abs(found - whole)[1:-1, 1:-1].max() <= 1 and whole.std() > 20
    assert [band["nodata"] for band in shade.bands] == [0] and surface.bands[0]["nodata"] == "nan"


def test_a_style_has_the_range_of_the_heights(tmp_path):
    heights = np.linspace(100, 200, 10_001).reshape(73, 137)
    write_heights_style(tmp_path / "surface.tif", heights, "m")
    values, colours, labels = stops(tmp_path / "surface.qml")
    assert np.allclose(np.array(values, float), [102, 126, 150, 174, 198])
    assert labels == ["102.00 m", "126.00 m", "150.00 m", "174.00 m", "198.00 m"]
    assert len(set(colours)) == 5 and all(len(each) == 7 for each in colours)


PERIOD = FIRST, LAST
ZONED = tuple(each.replace(tzinfo=timezone.utc) for each in PERIOD)


def item_of(period=ZONED, crs="EPSG:32633"):
    return stac_item(
        "site",
        GRID,
        period,
        ASSETS,
        {"surface.tif": [{"name": "height", "data_type": "float32", "nodata": "nan", "unit": "m"}]},
        {
            "crs": crs,
            "files": ["surface.tif", "contours.geojson"],
            "vertical_reference": "unknown",
            "ground_sampling_distance": 0.02,
        },
    )


@pytest.mark.parametrize("options", [{}, {"period": PERIOD}, {"crs": 'PROJCRS["a", ...]'}])
def test_an_item_is_valid_and_states_only_what_is_known(tmp_path, options, monkeypatch):
    monkeypatch.setattr(
        "clsplat.apps.stac.on_ground",
        lambda source, target, points: np.subtract(points, (4e5, 5.7e6, 0)) / 1e5 + (13.5, 51.4, 0),
    )
    pystac = pytest.importorskip("pystac", reason="pystac is not installed (extra test)")
    from pystac.validation.stac_validator import JsonSchemaSTACValidator

    record = item_of(**options)
    (tmp_path / "item.json").write_text(json.dumps(record, allow_nan=False))
    item = pystac.Item.from_file(str(tmp_path / "item.json"))
    # the schemas that it brings along; those of extensions are on the network
    JsonSchemaSTACValidator().validate_core(record, pystac.STACObjectType.ITEM, "1.1.0")
    place = pystac.extensions.projection.ProjectionExtension.ext(item)
    assert place.bbox == list(GRID.bounds) and place.shape == [300, 700]
    assert place.transform == [0.5, 0, 4e5, 0, -0.5, 5.7e6]
    assert Path(item.assets["surface_tif"].get_absolute_href()) == tmp_path / "surface.tif"
    (west, south), *_, last = record["geometry"]["coordinates"][0]
    assert record["bbox"][:2] == last == [west, south]
    assert (place.code, place.wkt2) == ((None, options["crs"]) if "crs" in options else ("EPSG:32633", None))
    start, end = (datetime.fromisoformat(record["properties"][f"{each}_datetime"][:-1]) for each in ("start", "end"))
    if "period" in options:  # of an unknown zone, which is UTC + 14 hours to UTC - 12 hours
        assert item.datetime is None
        assert (start, end) == (FIRST - timedelta(hours=14), LAST + timedelta(hours=12))
    else:
        assert (start, end) == PERIOD and item.datetime == ZONED[0]


def test_the_corners_of_an_item_are_longitudes_and_latitudes():
    west, south, east, north = item_of()["bbox"]
    assert west == pytest.approx(13.5603, abs=1e-3) and south == pytest.approx(51.4416, abs=1e-3)
    assert 0.004 < east - west < 0.006 and 0.0013 < north - south < 0.0015


def test_what_the_files_of_photos_tell(tmp_path):
    (tmp_path / "images").mkdir()
    facts = [
        CLOCK,
        {**CLOCK, **UTC, "Make": "DJI", "Model": "FC6360"},
        {**UTC, "GPS:TimeStamp": (5.0, 0.0, 0.0), "Make": "DJI", "Model": "DJI FC6360"},
    ]
    paths = [photo(tmp_path / "images" / f"{number}.jpg", exif) for number, exif in enumerate(facts)]
    views = made.scene().views
    scene = replace(
        made.scene(),
        path=tmp_path,
        views=tuple(
            View(path.name, views[0].camera, source)  # another folder has undistorted photos
            for path, source in zip(paths, (paths[0], tmp_path / "b.jpg", paths[2]))
        ),
    )
    found = photographs_of(scene)
    assert found.cameras == {"unknown camera, 64 x 48 pixels": 1, "DJI FC6360, 64 x 48 pixels": 2}
    assert [f"{each:%H:%M:%S%z}" for each in found.period] == ["03:59:58+0000", "05:00:00+0000"]
    assert photographs_of(replace(scene, views=views)) == Photographs({}, None)


@pytest.mark.slow
def test_a_map_has_its_styles_item_and_report(item_device, tmp_path, monkeypatch):
    monkeypatch.setattr(map_module, "photographs_of", lambda _: Photographs({"DJI FC6360, 64 x 48 pixels": 9}, ZONED))
    pages = []

    def write(*content):
        pages.append([list(each) for each in content[3:]])
        if len(pages) == 1:  # to draw them takes longer than the map
            write_pages(*content[:3], *pages[0])

    monkeypatch.setattr(map_module, "write_preview", lambda *_: None)
    monkeypatch.setattr(map_report, "write_pages", write)
    place = replace(made.UTM, vertical="EGM96 height")
    grid, record, _, heights = drawn(item_device, tmp_path, 0.1, place, terrain=7.0)
    assert sorted(record["files"]) == sorted({path.name for path in tmp_path.iterdir()} - {"map.json"})
    assert record["files"][:5] == [
        "orthophoto.tif",
        "surface.tif",
        "terrain.tif",
        "hillshade.tif",
        "terrain_hillshade.tif",
    ]
    values, _, labels = stops(tmp_path / "surface.qml")
    assert (
        np.allclose(np.array(values, float)[[0, -1]], np.nanquantile(heights, (0.02, 0.98)), atol=1e-3)
        and labels[0] == f"{float(values[0]):.2f} m"
    )
    ground = np.array(stops(tmp_path / "terrain.qml")[0], float)
    assert np.ptp(ground) < 0.1 < np.ptp(np.array(values, float))
    for shade, source in (("hillshade", "surface"), ("terrain_hillshade", "terrain")):
        with rasterio.open(tmp_path / f"{shade}.tif") as file, rasterio.open(tmp_path / f"{source}.tif") as of:
            assert file.nodata == NODATA and file.tags(ns="IMAGE_STRUCTURE")["LAYOUT"] == "COG"
            assert np.array_equal(file.read(1) == NODATA, np.isnan(of.read(1)))
            tags = file.tags()
            assert tags["HILLSHADE_AZIMUTH"] == "315 degrees"
            assert tags["HILLSHADE_ALTITUDE"] == "45 degrees"
            assert tags["VERTICAL_REFERENCE"] == of.tags()["VERTICAL_REFERENCE"] == "EGM96 height"
        grey = ElementTree.parse(tmp_path / f"{shade}.qml").getroot().find(".//rasterrenderer")
        assert grey.get("type") == "singlebandgray" and grey.findtext(".//maxValue") == "255"
    item = json.loads((tmp_path / "item.json").read_text())
    assert item["properties"]["clsplat:vertical_reference"] == "EGM96 height"
    assert {asset["href"][2:] for asset in item["assets"].values()} == (set(record["files"]) - {"item.json"})
    assert [band["name"] for band in item["assets"]["surface_tif"]["bands"]] == ["height", "spread"]
    assert (tmp_path / "survey.pdf").read_bytes().count(b"/Type /Page ") == 5
    tables, sheets = pages[0]
    facts = {key: value for table in tables for key, value in table.rows}
    assert facts["camera"] == "DJI FC6360, 64 x 48 pixels: 9 photos"
    assert facts["taken"] == "2024-06-01 10:00 to 2024-06-01 10:20, UTC"
    assert facts["heights"] == "EGM96 height" and facts["check points"].startswith("none, so that")
    assert [sheet.title for sheet in sheets] == ["Coverage", "Orthophoto", "Surface", "Terrain"]
    for sheet in sheets:
        assert np.allclose(sheet.bounds, grid.bounds, atol=4) and sheet.north and sheet.unit == "m"
    assert np.abs(sheets[0].dots - (made.OFFSET + place.offset)[:2]).max() == pytest.approx(6)
    assert sheets[0].scale[1] == np.nanmax(sheets[0].pixels) == 9, "photos, in the middle"
    monkeypatch.setattr(map_report, "facts", lambda _: int("damaged"))
    checked = replace(place, residuals=(Residual("1", CHECK, 0.1, 0.2, 0.3, 1.0),))
    monkeypatch.setattr(map_module, "survey_of", lambda scene: survey_of(replace(scene, views=scene.views[2::3])))
    drawn(item_device, tmp_path, 0.1, checked)
    assert not (tmp_path / "terrain.tif").exists(), "of the earlier map"
    rows = np.nanmean(pages[1][1][0].pixels, axis=1)
    assert rows[:9].mean() > rows[-9:].mean() + 1, "the photos of the north"
    titles = [table.title for table in pages[1][0] if table.rows]
    assert titles[0] == "Warnings" and "Accuracy" not in titles
    assert "Ground control points" in titles
    drawn(item_device, tmp_path, 0.1, None)
    assert dict(pages[2][0][2].rows)["heights"] == "unknown: the vertical system of the scene"
    left = {path.name for path in tmp_path.iterdir()}
    assert not left & {"item.json", "terrain.qml", "terrain_hillshade.tif"}, "of the earlier map"
