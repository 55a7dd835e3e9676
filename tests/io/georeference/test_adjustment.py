"""A bent reconstruction is adjusted to ground control points, and wrong ones are left out."""

from dataclasses import replace

import numpy as np
import pycolmap
import pytest

from clsplat.errors import InputError
from clsplat.io.georeference.adjustment import check_marks
from clsplat.io.georeference.control_points import ControlPoint, ControlPoints
from clsplat.io.georeference.reconstruction import place_reconstruction
from tests.data.survey import CRS, ORIGIN
from tests.sfm.cases import synthetic

METRES = 100.0  # in a unit of the synthetic scene


def control(count, checks=0):
    """Points of the synthetic scene whose places on the map are known, the last as check points."""
    truth = synthetic(photos=8, points=150)
    points = []
    for number in sorted(truth.point3D_ids())[:count]:
        point = truth.point3D(number)
        marks = ((truth.images[each.image_id], each.point2D_idx) for each in point.track.elements)
        points.append(
            ControlPoint(
                f"P{number}",
                tuple(ORIGIN + METRES * point.xyz),
                tuple((image.name, *image.points2D[index].xy.tolist()) for image, index in marks),
                len(points) >= count - checks,
            )
        )
    return points


def bent():
    """The reconstruction with a wrong lens, to which poses and points were fitted."""
    reconstruction = synthetic(photos=8, points=150)
    reconstruction.cameras[1].params = [430.0, 160.0, 120.0, 0.0]
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_focal_length = options.refine_extra_params = options.print_summary = False
    pycolmap.bundle_adjustment(reconstruction, options)
    return reconstruction


def placed(points, **options):
    """What became of the bent reconstruction, and the largest error of its cameras, metres."""
    reconstruction, truth = bent(), synthetic(photos=8, points=150)
    result = place_reconstruction(reconstruction, {}, ControlPoints(tuple(points), CRS), up=(0, 0, 1), **options)
    away = [
        result.georeference.to_map(image.projection_center())
        - (ORIGIN + METRES * truth.images[number].projection_center())
        for number, image in reconstruction.images.items()
    ]
    return result, np.abs(away).max()


def test_the_adjustment_takes_out_what_a_similarity_leaves():
    points = control(8, checks=3)
    rigid, away = placed(points)
    assert rigid.georeference.residual > 0.1 and away > 10
    adjusted, away = placed(points, adjusts=True)
    assert away < 0.02 and adjusted.georeference.residual < 0.01
    found = adjusted.georeference.residuals
    assert [each.role for each in found] == 5 * ["control"] + 3 * ["check"]
    assert max(abs(each.up) for each in found) < 0.01
    assert adjusted.notes[0].startswith("adjusted to 5 ground control points: residual 0.0")
    assert "--check-point" in placed(control(5), adjusts=True)[0].notes[1]
    assert adjusted.notes[1].startswith("3 check points, which took no part: residual 0.0")


@pytest.mark.parametrize("keep", [True, False])
def test_the_focal_length_of_a_calibration_is_kept(keep):
    reconstruction = bent()
    tie_points = reconstruction.point3D_ids()
    place_reconstruction(
        reconstruction, {}, ControlPoints(tuple(control(5)), CRS), adjusts=True, up=(0, 0, 1), keep_focal=keep
    )
    assert (reconstruction.cameras[1].params[0] == 430) == keep
    assert reconstruction.point3D_ids() == tie_points  # the scene has none of the control points


def test_check_points_take_no_part():
    points = control(7, checks=1)
    east, north, height = points[6].position
    points[6] = replace(points[6], position=(east + 3, north, height))
    result, away = placed(points, adjusts=True)
    assert away < 0.02 and result.georeference.residual == pytest.approx(3, abs=0.02)
    assert result.georeference.residuals[6].role == "check"
    assert result.georeference.residuals[6].east == pytest.approx(-3, abs=0.02)


@pytest.mark.parametrize("adjusts", [True, False])
def test_a_wrong_height_is_left_out_and_named(adjusts):
    points = control(7)
    east, north, height = points[2].position
    points[2] = replace(points[2], position=(east, north, height + 20))
    result, away = placed(points, adjusts=adjusts)
    assert result.georeference.residuals[2].role == "left out"
    assert result.georeference.residuals[2].up == pytest.approx(-20, abs=1)
    assert f"6 ground control points, without {points[2].name}, which contradict" in result.notes[0]
    assert away < (0.05 if adjusts else 50)


def test_control_points_that_do_not_fit_the_photos_are_refused():
    points = control(3)
    east, north, height = points[1].position
    points[1] = replace(points[1], position=(east + 40, north, height))
    with pytest.raises(InputError, match="fewer than 3 ground control points agree with the phot"):
        placed(points, adjusts=True)


def test_marks_must_name_one_photo_each():
    """A list may leave out the folders; drones number the photos of each from the same number."""
    name = (points := control(3))[0].marks[0][0]
    for photos, words in (
        ({"other.jpg"}, "no photo has a name of those in the file, such"),
        ({f"b/{name}", f"a/{name}"}, f"2 photos have the name {name}; wri"),
    ):
        with pytest.raises(InputError, match=f"--gcp: {words}"):
            check_marks(points, photos)
    for photos in ({f"flight/{name}"}, {f"a/{name}", name}):
        check_marks(points, photos)
