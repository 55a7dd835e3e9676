"""Coordinate reference systems: their names, and conversions."""

import numpy as np
import pytest

from clsplat.errors import InputError
from clsplat.io.georeference import crs as systems
from clsplat.io.georeference.crs import conversion, map_positions, normal_crs, on_ground, scene_crs


def test_other_systems():
    assert scene_crs("EPSG:25832") == "EPSG:25832"
    assert normal_crs("+proj=utm +zone=32 +datum=WGS84").startswith(("EPSG:32632", "PROJCRS"))
    local = normal_crs("+proj=tmerc +lon_0=9 +x_0=1000 +ellps=GRS80")
    assert local.startswith("PROJCRS") and "\n" not in local
    positions, crs = map_positions([[50.0, 9.0]], [3.0], local)
    assert crs == local and positions[0, 0] == pytest.approx(1000) and positions[0, 2] == 3
    assert np.allclose(on_ground(local, "EPSG:4326", positions), [[9, 50, 3]])
    for text in ("EPSG:4326", "EPSG:2277", "EPSG:3857"):  # degrees, feet, not of the ground
        with pytest.raises(InputError, match="not a projected coordinate reference system in met"):
            scene_crs(text)
    for text in ("EPSG:99999", "the moon"):
        with pytest.raises(InputError, match="is not a coordinate reference system; give one"):
            scene_crs(text)


def test_degrees_to_metres_and_to_the_earth():
    # the meeting of a central meridian and the equator
    assert np.allclose(
        conversion("OGC:CRS84", "EPSG:32633", "--polygon")(np.array([[15.0, 0.0], [15.0, 1e-5]])),
        [[500_000, 0], [500_000, 1.105]],
        atol=1e-3,
    )
    earth = conversion("EPSG:32631", "EPSG:4978", "tiles")(np.array([[500_000.0, 0, 10]]))
    angle = np.radians(3)
    assert np.allclose(earth, 6378147 * np.array([[np.cos(angle), np.sin(angle), 0]]), atol=1e-3)


def test_what_cannot_be_converted():
    with pytest.raises(InputError, match="--polygon: coordinates in nowhere cannot be converted"):
        conversion("nowhere", "EPSG:32633", "--polygon")
    with pytest.raises(InputError, match="have no coordinates in EPSG:32633"):
        conversion("OGC:CRS84", "EPSG:32633", "--polygon")(np.array([[1000.0, 2000.0]]))


@pytest.mark.parametrize(
    "place, crs, east, north",
    [
        ((30.17115, -98.08987), "EPSG:32614", 587630.75, 3338100.22),
        ((-33.9, 18.4), "EPSG:32734", 259583.2, 6245888.0),
        ((0.0, 180.0), "EPSG:32601", 166021.44, 0),
    ],
)
def test_the_utm_zone_of_a_place(place, crs, east, north):
    positions, zone = map_positions([place], [7.5])
    assert zone == crs and positions[0] == pytest.approx((east, north, 7.5), abs=0.1)
    assert np.array_equal(map_positions([place], [7.5], crs)[0], positions)


def test_places_that_are_not_on_the_earth():
    """pycolmap raised ValueError for all places if one was wrong."""
    places, crs = map_positions([[52.4, 16.9], [95.0, 16.9]], [80.0, 80.0])
    assert crs == "EPSG:32633" and np.isfinite(places[0]).all() and np.isnan(places[1]).all()
    assert np.isnan(map_positions([[5e6, 5e5]], [0.0])[0]).all()


@pytest.mark.parametrize(
    "definition, crs",
    [
        ("EPSG:32633", "EPSG:32633"),
        ("EPSG:32633+5773", "EPSG:32633"),
        ("EPSG:4326", ""),
        ("EPSG:2263", ""),
        ("EPSG:3045", "EPSG:3045"),
        ("EPSG:3857", ""),
        ("nonsense", ""),
        ("", ""),
        ("a\0b", ""),
    ],
)
def test_definitions_that_a_map_can_have(definition, crs):
    """Projected, in metres."""
    assert systems.project_crs(definition) == crs
