"""Positions by GPS and reconstructions are placed on maps where pyproj says."""


import numpy as np
import pyproj
import pytest

from clsplat.io.georeference.crs import map_positions
from clsplat.io.georeference.earth import on_map, topocentric
from clsplat.placement.similarity import Similarity

HERE, THERE = (30.17115, -98.08987), (-33.9, 18.4)


@pytest.mark.parametrize("place, crs, east, north", [
    (HERE, "EPSG:32614", 587630.75, 3338100.22), (THERE, "EPSG:32734", 259583.2, 6245888.0)])
def test_the_utm_zone_of_a_place(place, crs, east, north):
    positions, zone = map_positions([place], [7.5])
    assert zone == crs and positions[0] == pytest.approx((east, north, 7.5), abs=0.1)
    assert np.array_equal(map_positions([place], [7.5], crs)[0], positions)


def test_places_that_are_not_on_the_earth():
    """pycolmap raised ValueError for all places if one was wrong."""
    places, crs = map_positions([[52.4, 16.9], [95.0, 16.9]], [80.0, 80.0])
    assert crs == "EPSG:32633" and np.isfinite(places[0]).all() and np.isnan(places[1]).all()
    assert np.isnan(map_positions([[5e6, 5e5]], [0.0])[0]).all()


def test_a_kilometre_of_cameras():
    """East of the zone's middle: what is left is the earth's curvature, centimetres."""
    random = np.random.default_rng(0)
    earth = topocentric(52.4, 17.9, 80.0)
    centres = random.uniform((-500, -500, 50), (500, 500, 150), (100, 3))
    similarity, georeference = on_map(earth, centres, "", "made")
    assert georeference.crs == "EPSG:32633" and georeference.offset[0] % 1 == 0
    exact = np.stack(pyproj.Transformer.from_crs("EPSG:4978", "EPSG:32633", always_xy=True)
                     .transform(*earth(centres).T), axis=1)
    places = georeference.to_map(similarity(centres))
    missed = np.linalg.norm(places - exact, axis=1)
    assert missed.max() < 0.1
    assert georeference.residual == pytest.approx(np.sqrt((missed**2).mean()))
    assert 0.9995 < similarity.scale < 1.0005
    assert np.abs(similarity(centres)).max() < 1500  # small numbers, the rest is the offset


def test_a_reconstruction_in_any_unit_and_frame():
    """The same cameras in other coordinates come to the same places."""
    random = np.random.default_rng(1)
    earth = topocentric(52.4, 17.9, 80.0)
    axes, place = earth.rotation, earth.translation
    centres = random.uniform(-100, 100, (20, 3))
    places, reference = on_map(earth, centres, "", "made")
    # any rotation, a large shift, 40 units a metre
    turn, shift = axes.T, np.array([3e4, -2e4, 1e4])
    other = 40 * centres @ turn.T + shift
    similarity, georeference = on_map(
        Similarity(1 / 40, axes @ turn.T, place - axes @ turn.T @ shift / 40), other, "", "made")
    np.testing.assert_allclose(
        georeference.to_map(similarity(other)),
        reference.to_map(places(centres)), atol=5e-3)


def test_cameras_that_are_not_on_the_earth():
    with pytest.raises(ValueError, match="earth's surface"):
        on_map(Similarity(1.0, np.eye(3), np.zeros(3)), np.ones((2, 3)), "", "made")
