"""Positions of photos as priors: they take the bowl out of strips, unless they are no good."""

from dataclasses import replace

import numpy as np
import pytest

from clsplat.io.georeference.control_points import ControlPoints
from clsplat.io.georeference.reconstruction import place_reconstruction
from tests.data.survey import Survey
from tools.studies.priors import FAR, RECEIVERS, Receiver, Strips, figures, measured

RTK, GPS = RECEIVERS["RTK, 2 cm, stated"], RECEIVERS["GPS, 2 m"]


@pytest.fixture(scope="module")
def strips():
    """The survey, and what photos alone make of it."""
    survey = Strips(photos=16)
    return survey, survey.reconstruction()


def worst(survey, errors):
    return figures(survey, errors)[2]


def test_rtk_straightens_a_survey_and_measures_its_lens(strips):
    survey, bent = strips
    known = survey.metadata(RTK)
    rigid, placed, _ = measured(survey, bent, known)
    assert placed.priors is None and worst(survey, rigid) > 0.3
    found, placed, made = measured(survey, bent, known, adjusts=True, keep_focal=True)
    assert worst(survey, found) < 0.2
    # outliers are left out, and do not pull
    effect, wrong = placed.priors, placed.georeference.names("left out")
    assert len(wrong) == 1 and effect.photos == effect.heights == 47
    assert effect.std == pytest.approx((0.02, 0.03)) and effect.moved[1] < 1
    assert effect.after[0] < 0.04 < 0.2 < effect.before[0] and effect.after[1] < 0.04
    assert placed.georeference.residual == pytest.approx(effect.after[0], abs=1e-3)
    assert any(note.startswith("adjusted to the positions of 47 photos") for note in placed.notes)
    lens = made.cameras[1]
    assert lens.principal_point_x == pytest.approx(2014, abs=4)
    assert max(abs(each.east) for each in placed.georeference.residuals if each.name in wrong) > FAR / 10


def test_the_same_positions_make_the_same_bytes(strips):
    survey, bent = strips
    places = [
        np.array(
            [
                image.projection_center()
                for image in measured(survey, bent, survey.metadata(RTK), adjusts=True)[2].images.values()
            ]
        )
        for _ in range(2)
    ]
    assert places[0].tobytes() == places[1].tobytes()


def test_gps_changes_the_shape_only_where_photos_leave_it_open(strips):
    survey, bent = strips
    _, placed, made = measured(survey, bent, survey.metadata(GPS), adjusts=True, keep_focal=True)
    assert placed.priors.std[0] == pytest.approx(2, rel=0.3)
    assert placed.priors.moved[1] < 0.5 and placed.priors.focal_percent == 0
    assert (made.cameras[1].principal_point_x, made.cameras[1].focal_length_x) == (2000, bent.cameras[1].focal_length_x)


def test_accuracies_that_are_stated_too_small_are_not_believed(strips):
    survey, bent = strips
    known = {
        name: replace(each, gps_std=(0.01, 0.01, 0.01))
        for name, each in survey.metadata(Receiver((1.0, 1.0, 1.0))).items()
    }
    found, placed, _ = measured(survey, bent, known, adjusts=True)
    assert min(placed.priors.std) > 0.5 and worst(survey, found) < 2


def test_heights_that_are_missing_leave_the_scene_level(strips):
    survey, bent = strips
    known = survey.metadata(replace(RTK, has_height=False))
    found, placed, _ = measured(survey, bent, known, adjusts=True)
    effect = placed.priors
    assert effect.heights == 0 and effect.std[1] is effect.before[1] is effect.after[1] is None
    assert found[:, 2].std() < 0.5 and " in height" not in str(effect)


@pytest.mark.parametrize("count, noise", [(12, 8.0), (3, 0.0)])
def test_positions_that_are_too_bad_or_too_few_are_no_priors(tmp_path, count, noise):
    survey = Survey(tmp_path)
    known = dict(list(survey.metadata(noise).items())[:count])
    bent, kept = survey.reconstruction(), survey.reconstruction()
    placed = place_reconstruction(bent, known, ControlPoints(), adjusts=True)
    assert placed.priors is None and placed.warnings
    place_reconstruction(kept, known, ControlPoints())
    assert all((bent.points3D[number].xyz == point.xyz).all() for number, point in kept.points3D.items())
