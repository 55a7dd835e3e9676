"""Lengths, areas and volumes of analytic shapes, in every coordinate system of a GeoJSON file."""

import csv
import json
import warnings

import numpy as np
import pytest

from clsplat.apps.geotiff import read_surface
from clsplat.apps.measure import measure
from clsplat.errors import InputError
from clsplat.evaluation.run import Run
from clsplat.io.georeference.crs import on_ground
from clsplat.io.georeference.geojson import read_features
from tests.apps.test_map import no_pictures, run_of  # noqa: F401  (a fixture)
from tests.command_line import clsplat_
from tests.data import ground_model as made
from tests.data.surfaces import (
    CRS,
    HEAP_VOLUME,
    HEIGHT,
    LEFT,
    MIDDLE,
    PIXEL,
    RADIUS,
    SIDE,
    TOP,
    circle,
    feature,
    heap,
    places,
    square,
    write_features,
    write_surface,
)

NOISE = 0.03


def noisy(heights, seed=1):
    return heights + np.random.default_rng(seed).normal(0, NOISE, heights.shape)


@pytest.fixture(scope="module")
def surfaces(tmp_path_factory):
    """A heap on a slope, without it, and the folder."""
    folder = tmp_path_factory.mktemp("surfaces")
    x, y = places()
    slope = 50 + 0.05 * x - 0.02 * y
    return (
        write_surface(folder / "late.tif", noisy(slope + heap(x, y))),
        write_surface(folder / "early.tif", noisy(slope, 2)),
        folder,
    )


def measured(surface, folder, *features, system=CRS, base="fit", before=None, **members):
    found = read_features(write_features(folder / "f.json", *features, **members), system)
    return measure(surface, found, base, before)


def test_the_volume_of_a_heap_on_a_slope(surfaces):
    late, _, folder = surfaces
    (row,) = measured(late, folder, feature("Polygon", [circle(RADIUS + 1)])).record["features"]
    assert abs(row["volume"] / HEAP_VOLUME - 1) < 0.02
    assert abs(row["area"] / (np.pi * (RADIUS + 1) ** 2) - 1) < 1e-3 and row["known"] == 1
    assert abs(row["base_slope"] - np.hypot(0.05, 0.02)) < 2e-3
    assert abs(row["base_height"] - 50) < 0.02
    assert abs(row["highest"] - 50 - HEIGHT) < 5 * NOISE and row["lowest"] < 49.4
    assert abs(row["volume"] - (row["above"] - row["below"])) < 1e-6
    assert row["below"] < 0.005 * HEAP_VOLUME, "the base slopes as the ground does"


@pytest.mark.parametrize("base, level", [("lowest", 49.25), ("mean", 50), (48.5, 48.5)])
def test_other_bases_are_level(surfaces, base, level):
    late, _, folder = surfaces
    half = 13.0
    (row,) = measured(late, folder, feature("Polygon", [square(half)]), base=base).record["features"]
    lowest = 50 - 0.07 * half
    level = lowest if base == "lowest" else level
    expected = HEAP_VOLUME + (50 - level) * (2 * half) ** 2
    slack = 5 * NOISE if base == "lowest" else 0.01
    assert abs(row["base_height"] - level) < slack and row["base_slope"] == 0
    assert abs(row["volume"] - expected) < 0.02 * expected + slack * (2 * half) ** 2


def test_holes_and_several_parts(surfaces):
    late, _, folder = surfaces
    corner = MIDDLE + 21  # all borders are those of pixels
    shape = [[square(7.5), square(4.5)], [square(3, corner)]]
    (row,) = measured(late, folder, feature("MultiPolygon", shape), base=0.0).record["features"]
    assert abs(row["area"] - (15**2 - 9**2 + 6**2)) < 1e-6
    assert abs(row["volume"] / row["area"] / row["mean"] - 1) < 1e-3
    (whole,) = measured(late, folder, feature("Polygon", [square(7.5)]), base=0.0).record["features"]
    hole, part = (
        measured(late, folder, feature("Polygon", [ring]), base=0.0).record["features"][0]
        for ring in (square(4.5), square(3, corner))
    )
    assert abs(row["volume"] - whole["volume"] + hole["volume"] - part["volume"]) < 1e-3 * whole["volume"]


def test_lengths_along_a_ramp_and_its_profile(tmp_path):
    x, y = places()
    surface = write_surface(tmp_path / "ramp.tif", noisy(10 + 0.75 * x))
    line = [(MIDDLE + (-20, 0)).tolist(), (MIDDLE + (12, 0)).tolist(), (MIDDLE + (12, 9)).tolist()]
    result = measured(
        surface, tmp_path, feature("LineString", line, "ramp"), feature("MultiLineString", [line[:2], line[1:]])
    )
    row, parts = result.record["features"]
    assert abs(row["length"] - 41) < 1e-6 and abs(row["surface_length"] - (32 * 1.25 + 9)) < 0.25
    assert parts["length"] == row["length"]
    profile = result.profiles[1]
    assert profile[0, 0] == 0 and abs(profile[-1, 0] - 41) < 1e-6
    assert np.allclose(profile[0, 1:3], line[0]) and np.allclose(profile[-1, 1:3], line[2])
    assert abs(result.profiles[2][-1, 0] - 41) < 1e-6, "parts follow each other"
    on_ramp = profile[:, 0] < 31
    rise = profile[on_ramp, 3] - (10 + 0.75 * (profile[on_ramp, 0] - 20))
    assert np.abs(rise).max() < 5 * NOISE and abs(rise.mean()) < 0.01
    assert np.diff(profile[:, 0]).max() < 1.01 * PIXEL


def test_what_came_and_went_since(surfaces):
    late, early, folder = surfaces
    heap_only = feature("Polygon", [circle(RADIUS + 1)], "heap")
    still = feature("Polygon", [square(3, MIDDLE + 20)], "still")
    record = measured(late, folder, heap_only, still, before=early).record
    came, none = record["features"]
    assert abs(record["noise"] / (2**0.5 * NOISE) - 1) < 0.2, "of both, between pixels smoothed"
    assert abs(record["offset"]) < 0.005
    assert abs(record["level_of_detection"] / record["noise"] - 1.96) < 1e-9
    assert abs(came["fill"] / HEAP_VOLUME - 1) < 0.02 and came["cut"] < 0.005 * HEAP_VOLUME
    assert abs(came["net"] / HEAP_VOLUME - 1) < 0.02 and came["compared"] > 0.99
    assert none["fill"] + none["cut"] < 0.4, "1.2 without the level of detection"
    assert abs(none["net"]) < 5 * none["net_noise"] < 1
    gone = measured(early, folder, heap_only, before=late).record["features"][0]
    assert abs(gone["cut"] / HEAP_VOLUME - 1) < 0.02 and gone["net"] < -0.98 * HEAP_VOLUME


def test_the_noise_of_a_volume_has_what_neighbours_share(tmp_path):
    """A slow wave of 3 cm makes a volume far less sure than noise of single pixels does."""
    x, y = places()
    still = feature("Polygon", [square(2)])
    found = []
    for wave in (0, 0.05 * np.sin(x / 4) * np.cos(y / 4)):
        late = write_surface(tmp_path / "late.tif", noisy(0 * x + wave))
        early = write_surface(tmp_path / "early.tif", noisy(0 * x, 2))
        (row,) = measured(late, tmp_path, still, before=early).record["features"]
        found.append(row["net_noise"])
    assert found[0] < 0.05 and found[1] > 0.2


@pytest.mark.parametrize(
    "members, target",
    [
        ({}, "EPSG:4326"),
        ({}, CRS),
        ({"crs": {"type": "name", "properties": {"name": "urn:ogc:def:crs:EPSG::25832"}}}, "EPSG:25832"),
        ({"crs": {"type": "name", "properties": {"name": "urn:ogc:def:crs:OGC:1.3:CRS84"}}}, "EPSG:4326"),
    ],
    ids=["degrees", "map", "another", "named degrees"],
)
def test_every_system_of_a_file_gives_the_same(surfaces, members, target):
    late, _, folder = surfaces
    ring = on_ground(CRS, target, np.pad(square(13), ((0, 0), (0, 1))))[:, :2].tolist()
    (row,) = measured(late, folder, feature("Polygon", [ring]), **members).record["features"]
    assert abs(row["area"] - 26**2) < 1e-3 and abs(row["volume"] / HEAP_VOLUME - 1) < 0.02


def test_unknown_heights_are_stated_and_local_coordinates_read(tmp_path):
    x, y = places()
    heights = np.where(x < 0, np.nan, 5.0)
    surface = write_surface(tmp_path / "half.tif", heights, crs=None)
    line = [(MIDDLE - (10, 0)).tolist(), (MIDDLE + (10, 0)).tolist()]
    record = measured(
        surface, tmp_path, feature("Polygon", [square(10)]), feature("LineString", line), system=None, base=4.0
    ).record
    area, way = record["features"]
    assert record["unit"] == "scene units" and abs(area["known"] - 0.5) < 0.01
    assert abs(area["volume"] - 200) < 1 and abs(way["known"] - 0.5) < 0.02
    assert abs(way["surface_length"] - 20) < 1e-6


def test_a_polygon_beyond_the_map_has_a_share_that_is_known(surfaces):
    late, early, folder = surfaces
    half = feature("Polygon", [square(10, MIDDLE + (PIXEL * SIDE / 2, 0))])
    (row,) = measured(late, folder, half, before=early, base=0.0).record["features"]
    assert abs(row["known"] - 0.5) < 0.01 and abs(row["compared"] - 0.5) < 0.01
    assert abs(row["area"] - 400) < 1e-6


def test_a_map_larger_than_memory_is_measured_in_coarser_pixels(tmp_path, monkeypatch):
    monkeypatch.setattr("clsplat.apps.measure.MOST_SIDE", 100)
    x, y = places()
    surface = write_surface(tmp_path / "s.tif", heap(x, y))
    (row,) = measured(surface, tmp_path, feature("Polygon", [circle(RADIUS + 1)])).record["features"]
    assert abs(row["volume"] / HEAP_VOLUME - 1) < 0.02


def test_the_command_writes_json_csv_and_a_table(surfaces, tmp_path):
    late, early, _ = surfaces
    line = [(MIDDLE - (10, 0)).tolist(), (MIDDLE + (10, 0)).tolist()]
    shapes = write_features(
        tmp_path / "f.json", feature("Polygon", [square(13)], "heap"), feature("LineString", line, "way")
    )
    words = "measure", late, "--geojson", shapes, "-o", tmp_path / "out", "--before", early
    result = clsplat_(*words)
    assert result.exit_code == 0, result.output
    head, heap_line, way_line = result.output.splitlines()[:3]
    assert "area, m²" in head and heap_line.split()[:2] == ["heap", "polygon"]
    assert "676.00" in heap_line and "level of detection" in result.output
    assert "-0.000" not in result.output
    record = json.loads((tmp_path / "out" / "measurements.json").read_text())
    assert record["crs"] == CRS and [row["name"] for row in record["features"]] == ["heap", "way"]
    with open(tmp_path / "out" / "measurements.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert float(rows[0]["volume"]) == record["features"][0]["volume"] and rows[1]["volume"] == ""
    with open(tmp_path / "out" / "profiles.csv", newline="") as file:
        profile = list(csv.DictReader(file))
    assert profile[-1]["feature"] == "2" and float(profile[-1]["distance"]) == 20
    again = clsplat_(*words)
    assert again.exit_code == 2 and "--overwrite" in again.output


@pytest.mark.slow
def test_a_run_is_drawn_first_and_the_folder_of_a_map_is_read(tmp_path, monkeypatch, no_pictures):  # noqa: F811
    monkeypatch.setattr(Run, "open", lambda path: run_of(path, made.scene()))
    middle = (made.OFFSET + made.UTM.offset)[:2]
    shapes = write_features(tmp_path / "f.json", feature("Polygon", [square(5, middle)], "house"))
    for folder in ("run", "map"):
        (tmp_path / folder).mkdir()
    assert clsplat_("map", "run", "-o", tmp_path / "map", "--resolution", 0.1).exit_code == 0
    volumes = []
    for name in ("run", "map"):
        output = tmp_path / f"{name}_measured"
        result = clsplat_("measure", tmp_path / name, "--geojson", shapes, "-o", output)
        assert result.exit_code == 0, result.output
        record = json.loads((output / "measurements.json").read_text())
        assert record["surface"] == str(tmp_path / name)
        volumes.append(record["features"][0]["volume"])
    house = (2 * made.HOUSE + 2 * 1.4 * made.SPACING) ** 2 * made.ROOF
    assert abs(volumes[0] / volumes[1] - 1) < 0.02 and abs(volumes[0] / house - 1) < 0.1


def out_of_degrees(x, y):
    return [[x, y], [x + 1, y], [x + 1, y + 1], [x, y]]


BOW = [
    [LEFT + 10, TOP - 10],
    [LEFT + 30, TOP - 30],
    [LEFT + 30, TOP - 14],
    [LEFT + 15, TOP - 30],
    [LEFT + 10, TOP - 10],
]
HOSTILE = {
    "no features": ({"type": "FeatureCollection", "features": []}, "no features"),
    "a list": ([1, 2], "not a JSON object"),
    "features are text": ({"type": "FeatureCollection", "features": "x"}, "no features"),
    "a feature is a number": ({"type": "FeatureCollection", "features": [3]}, "without a geometry"),
    "properties are a list": (
        {"type": "Feature", "properties": [1], "geometry": {"type": "Polygon", "coordinates": [[1]]}},
        "feature 1 has coordinates of no polygon",
    ),
    "a point": (feature("Point", [1, 2], "well"), "well is Point"),
    "text for a number": (feature("LineString", [["1", "2"], ["3", "4"]]), "of no line"),
    "null": (feature("LineString", [[None, 2], [3, 4]]), "of no line"),
    "a flag": (feature("LineString", [[True, 2], [3, 4]]), "of no line"),
    "one vertex": (feature("LineString", [[1, 2]]), "of no line"),
    "coordinates missing": (feature("Polygon", None), "of no polygon"),
    "coordinates nested too little": (feature("Polygon", [[1, 2], [3, 4]]), "of no polygon"),
    "no parts": (feature("MultiPolygon", []), "of no polygon"),
    "a part without rings": (feature("MultiPolygon", [[]]), "of no polygon"),
    "an open ring": (feature("Polygon", [[[0, 0], [1, 0], [1, 1], [0, 1]]]), "of no polygon"),
    "NaN": ('{"type": "LineString", "coordinates": [[NaN, 1], [2, 3]]}', "not a finite number"),
    "infinite": ('{"type": "LineString", "coordinates": [[1e999, 1], [2, 3]]}', "not a finite number"),
    "no JSON": ("hello", "not GeoJSON"),
    "outside": (feature("Polygon", [square(5, MIDDLE + 5000)], "far"), "far: "),
    "outside in degrees": (feature("Polygon", [out_of_degrees(10, 40)]), "feature 1: "),
    "degrees beyond the map": (feature("Polygon", [out_of_degrees(-170, -89)]), "feature 1"),
    "crosses itself": (feature("Polygon", [BOW], "bow"), "bow: its border crosses itself"),
    "without an area": (feature("Polygon", [[BOW[0], BOW[1], BOW[0], BOW[0]]]), "no area"),
    "a line that leaves the earth": (
        feature("LineString", [list(MIDDLE), [1e99, 1e99]], "way"),
        "way: is 1.41e+99 m long",
    ),
    "a vast polygon": (feature("Polygon", [square(1e50)]), "feature 1: is 8e+50 m long"),
    "an unknown system": (
        {**feature("Polygon", [square(5)]), "crs": {"type": "name", "properties": {"name": "EPSG:1"}}},
        "coordinate reference system",
    ),
    "a system without a name": ({**feature("Polygon", [square(5)]), "crs": 7}, "no name"),
}


def refused(result, message):
    assert result.exit_code == 2 and message in result.output, result.output
    lines = result.output.strip().splitlines()
    assert len(lines) == 1 and lines[0].startswith(("error: ", "Error: ")) and len(lines[0]) < 500


@pytest.mark.parametrize("shapes, message", HOSTILE.values(), ids=HOSTILE)
def test_hostile_features_are_refused_in_one_line(surfaces, tmp_path, shapes, message):
    path = tmp_path / "f.json"
    path.write_text(shapes if isinstance(shapes, str) else json.dumps(shapes))
    refused(clsplat_("measure", surfaces[0], "--geojson", path, "-o", tmp_path / "o"), message)
    assert not (tmp_path / "o").exists()


BAD_RASTERS = {
    "no data": ({"heights": np.full((9, 9), np.nan)}, "has no heights"),
    "a picture": ({"heights": np.zeros((4, 9, 9)), "dtype": "uint8", "nodata": None}, "4 bands of uint8"),
    "degrees": ({"heights": np.ones((9, 9)), "crs": "EPSG:4326", "left": 15, "top": 51, "pixel": 1e-5}, "not metres"),
    "feet": ({"heights": np.ones((9, 9)), "crs": "EPSG:2263"}, "not metres"),
    "Web Mercator": ({"heights": np.ones((9, 9)), "crs": "EPSG:3857"}, "not metres"),
}


@pytest.mark.parametrize("options, message", BAD_RASTERS.values(), ids=BAD_RASTERS)
def test_hostile_rasters_are_refused_in_one_line(tmp_path, options, message):
    surface = write_surface(tmp_path / "s.tif", **options)
    shapes = write_features(tmp_path / "f.json", feature("Polygon", [square(5)]))
    refused(clsplat_("measure", surface, "--geojson", shapes, "-o", tmp_path / "o"), message)


def test_numbers_that_are_none(tmp_path):
    """A place that is NaN is refused; heights that are NaN are none, signalling ones too."""
    heights = np.zeros((40, 40), np.float32)
    heights.view(np.uint32)[:2] = 0x7F800001
    surface = write_surface(tmp_path / "s.tif", heights)
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        found = read_surface(surface).heights
        assert np.isnan(found[:2]).all() and not found[2:].any()
        write_surface(surface, heights, top=np.nan)
        with pytest.raises(InputError, match="s.tif: its pixels are not square"):
            read_surface(surface)


def test_other_files_and_words_are_refused_in_one_line(surfaces, tmp_path):
    late, early, _ = surfaces
    shapes = write_features(tmp_path / "f.json", feature("Polygon", [square(5)]))
    (tmp_path / "text.tif").write_text("no tif")
    (tmp_path / "empty").mkdir()
    x, y = places()
    other = write_surface(tmp_path / "other.tif", 0 * x, crs="EPSG:32632")
    hole = write_surface(tmp_path / "hole.tif", np.where(np.hypot(x, y) < 20, np.nan, 1))
    far = write_surface(tmp_path / "far.tif", 0 * x, left=LEFT + 9000)
    output = "-o", tmp_path / "o"
    for words, message in (
        ((tmp_path / "text.tif", "--geojson", shapes), "cannot be read as a GeoTIFF"),
        ((tmp_path / "missing.tif", "--geojson", shapes), "cannot be read as a GeoTIFF"),
        ((tmp_path / "empty", "--geojson", shapes), "holds no run"),
        ((late, "--geojson", tmp_path / "missing.json"), "no such file"),
        ((late, "--geojson", tmp_path), "not GeoJSON"),
        ((hole, "--geojson", shapes), "feature 1: "),
        ((late, "--geojson", shapes, "--before", other), "gdalwarp"),
        ((late, "--geojson", shapes, "--before", far), "shares no known place"),
        ((late, "--geojson", shapes, "--base", "highest"), "--base"),
        ((late, "--geojson", shapes, "--base", "nan"), "--base"),
    ):
        refused(clsplat_("measure", *words, *output), message)
