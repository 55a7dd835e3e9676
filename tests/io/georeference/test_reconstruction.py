"""A reconstruction is given its place by GPS, by ground control points, or by neither."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from clsplat.camera import Camera
from clsplat.errors import InputError
from clsplat.io.georeference.control_points import ControlPoint, ControlPoints
from clsplat.io.georeference.crs import normal_crs
from clsplat.io.georeference.reconstruction import place_reconstruction, turned
from clsplat.io.photos.metadata import PhotoMetadata
from clsplat.io.scenes.colmap_files import write_colmap
from clsplat.placement.plausible import NotGeoreferenced
from clsplat.scene import View
from tests.data.survey import CRS, Survey


@pytest.fixture(scope="module")
def survey(tmp_path_factory):
    return Survey(tmp_path_factory.mktemp("survey"))


def error(survey, reconstruction, georeference):
    """The largest distance of a camera from its true place, metres."""
    centres = {image.name: image.projection_center() for image in reconstruction.images.values()}
    placed = georeference.to_map([centres[name] for name in survey.names])
    assert np.abs(georeference.from_map(placed)).max() < 500  # the files hold small numbers
    return np.abs(placed - survey.centres).max()


def test_gps_gives_metres_in_the_utm_zone(survey):
    reconstruction = survey.reconstruction()
    placed = place_reconstruction(reconstruction, survey.metadata(), ControlPoints())
    assert placed.georeference.crs == CRS and placed.up.tolist() == [0, 0, 1]
    assert placed.georeference.source == "GPS of 12 photos" and placed.georeference.residual < 0.01
    assert error(survey, reconstruction, placed.georeference) < 0.02
    assert all(value == round(value) for value in placed.georeference.offset)


def test_altitudes_are_not_labelled_as_heights_of_a_crs(survey):
    crs = normal_crs(f"{CRS}+5773")
    placed = place_reconstruction(survey.reconstruction(), survey.metadata(), ControlPoints(crs=crs))
    assert placed.georeference.crs == CRS and "altitudes" in placed.georeference.vertical
    assert any(note.startswith("heights are not in EGM96 height") for note in placed.notes)


def test_a_bad_fix_is_named(survey):
    metadata = survey.metadata()
    bad = survey.names[3]
    metadata[bad] = replace(metadata[bad], latitude=metadata[bad].latitude + 0.01)
    reconstruction = survey.reconstruction()
    placed = place_reconstruction(reconstruction, metadata, ControlPoints())
    assert placed.georeference.source == f"GPS of 11 photos, without {bad}, whose positions are wrong"
    assert error(survey, reconstruction, placed.georeference) < 0.05


def test_without_altitudes_the_cameras_level_the_scene(survey):
    metadata = {name: replace(known, altitude=None) for name, known in survey.metadata().items()}
    reconstruction = survey.reconstruction()
    place_reconstruction(reconstruction, metadata, ControlPoints())
    ground = np.array([point.xyz for point in reconstruction.points3D.values()])
    assert np.ptp(np.quantile(ground[:, 2], (0.05, 0.95))) < 15 < np.ptp(ground[:, 0])


def test_without_gps_the_scene_is_turned_as_viewers_expect(survey):
    metadata = dict(list(survey.metadata().items())[:2])
    for known, why in (({}, "no photo has GPS"), (metadata, "only 2 photos have GPS")):
        reconstruction = survey.reconstruction()
        with pytest.raises(NotGeoreferenced) as caught:
            place_reconstruction(reconstruction, known, ControlPoints())
        placed = turned(reconstruction, known, caught.value)
        assert placed.georeference is None and not placed.warnings
        assert placed.notes == (f"not georeferenced: {why}",)
        assert placed.up.tolist() == [0, -1, 0]
        heights = -np.array([image.projection_center()[1] for image in reconstruction.images.values()])
        ground = -np.array([point.xyz[1] for point in reconstruction.points3D.values()])
        assert heights.min() > np.quantile(ground, 0.9)


@pytest.mark.parametrize("stored_upright", [True, False])
def test_portraits_stand_upright_however_they_are_stored(tmp_path, stored_upright):
    """Photos of a telephone, which stores portraits as landscapes that EXIF turns."""
    places = np.random.default_rng(0).normal(size=(50, 3))
    views = []
    for angle in np.linspace(0, np.pi, 12):
        position = 6 * np.cos(angle), 6 * np.sin(angle), 1.0
        camera = Camera.looking_at((0, 0, 0), position, width=48, height=64)
        camera = camera.turned(0 if stored_upright else 3)
        views.append(View(f"{len(views)}.jpg", camera, Path("none")))
    write_colmap(tmp_path, views, places, np.zeros((50, 3), np.uint8))
    reconstruction = pycolmap.Reconstruction(tmp_path)
    # the first scene is one whose photos were turned, and the metadata are of the originals
    turned(
        reconstruction,
        {view.name: PhotoMetadata(64, 48, orientation=6) for view in views},
        NotGeoreferenced("no photo has GPS"),
    )
    heights = [image.projection_center()[1] for image in reconstruction.images.values()]
    assert heights == pytest.approx(12 * [-1])


def control(survey, indices, shift=0.0):
    return [
        ControlPoint(
            f"P{index}", tuple(survey.points[index]), tuple((name, x + shift, y) for name, x, y in survey.marks(index))
        )
        for index in indices
    ]


def best_seen(survey, count):
    return sorted(range(20, 200), key=lambda index: -len(list(survey.marks(index))))[:count]


@pytest.mark.parametrize("marks", [(("nowhere.jpg", 1.0, 1.0),), None])
def test_control_points_give_the_place_without_gps(survey, marks):
    """One cannot be located, as its photo is missing or its rays do not meet; and a mark of another
    is wrong."""
    reconstruction = survey.reconstruction()
    points = control(survey, best_seen(survey, 5))
    lost = ControlPoint("lost", (0.0, 0.0, 0.0), marks or (points[0].marks[0], (points[0].marks[1][0], 1.0, 1.0)))
    (name, x, y), *others = points[0].marks
    points[0] = replace(points[0], marks=((name, 64 * (x < 32), 48 * (y < 24)), *others))
    placed = place_reconstruction(reconstruction, {}, ControlPoints((*points, lost), CRS))
    assert placed.georeference.source.startswith("5 ground control points, without lost, which")
    assert error(survey, reconstruction, placed.georeference) < 0.05


def test_marks_in_the_pixels_of_larger_photos_are_refused(survey):
    points = [
        replace(point, marks=tuple((name, 4 * x, 4 * y) for name, x, y in point.marks))
        for point in control(survey, best_seen(survey, 5))
    ]
    with pytest.raises(InputError, match="in the pixels of the photos that were reconstructed"):
        place_reconstruction(survey.reconstruction(), {}, ControlPoints(tuple(points), CRS))


def test_control_points_far_from_the_photos_own_gps_are_refused(survey):
    metadata = {name: replace(known, latitude=known.latitude + 0.1) for name, known in survey.metadata().items()}
    points = ControlPoints(tuple(control(survey, best_seen(survey, 5))), CRS)
    with pytest.raises(InputError, match="place the photos 11 km from their GPS: is it the right"):
        place_reconstruction(survey.reconstruction(), metadata, points)
