import json

import numpy as np
import pytest

from clsplat.apps.edit import read_polygons
from tests.refusals import refused

RING = [[0, 0], [4, 0, 7.5], [4, 4], [0, 0]]


def read(tmp_path, record):
    path = tmp_path / "area.geojson"
    path.write_text(record if isinstance(record, str) else json.dumps(record))
    return read_polygons(path)


def polygon(*rings):
    return {"type": "Polygon", "coordinates": list(rings)}


def test_every_place_of_a_polygon(tmp_path):
    other = {"type": "MultiPolygon", "coordinates": [[RING], [RING, RING]]}
    features = [
        {"type": "Feature", "geometry": geometry}
        for geometry in (
            polygon(RING),
            None,
            {"type": "Point", "coordinates": [1, 2]},
            {"type": "GeometryCollection", "geometries": [other]},
        )
    ]
    polygons, crs = read(tmp_path, {"type": "FeatureCollection", "features": features})
    assert sorted(map(len, polygons)) == [1, 1, 2] and crs == ""
    assert np.array_equal(polygons[0][0], np.array(RING[:1] + [[4, 0], [4, 4], [0, 0]]))
    for record in (polygon(RING), {"type": "Feature", "geometry": polygon(RING)}):
        assert len(read(tmp_path, record)[0]) == 1


def test_the_crs_of_older_files(tmp_path):
    name = "urn:ogc:def:crs:EPSG::32633"
    crs = {"type": "name", "properties": {"name": name}}
    assert read(tmp_path, {**polygon(RING), "crs": crs})[1] == name
    for odd in (None, "EPSG:4326", {"properties": []}):
        assert read(tmp_path, {**polygon(RING), "crs": odd})[1] == ""


@pytest.mark.parametrize(
    "record",
    [
        "",
        "{",
        "[]",
        "7",
        '{"type": "Polygon", "coordinates": [[[NaN, 0], [1, 0], [1, 1]]]}',
        {"type": "Feature", "geometry": 7},
        {"type": "Circle"},
        {},
        {"type": "FeatureCollection", "features": {}},
        polygon(),
        polygon([]),
        polygon(RING[:2]),
        polygon([[0, 0], [1], [1, 1]]),
        polygon([[0, 0], ["x", 0], [1, 1]]),
        polygon(7),
        polygon([[0, 0], [1e300, 0], [1, 1]]),
        {"type": "Feature"},
        {"type": "MultiPolygon", "coordinates": [7]},
        '{"type":' * 3000,
    ],
)
def test_what_is_no_polygon(tmp_path, record):
    refused(lambda: read(tmp_path, record), "area.geojson: not GeoJSON, damaged or")


def test_without_polygons(tmp_path):
    refused(lambda: read(tmp_path, {"type": "FeatureCollection", "features": []}), "has no polygon")
    refused(lambda: read_polygons(tmp_path / "missing.geojson"), "no such file")
