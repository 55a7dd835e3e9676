"""`clsplat georeference`: what it says, and what it refuses."""

import json

import numpy as np
import pytest

from clsplat.io.scenes.read import read_scene
from tests.command_line import clsplat_
from tests.data.survey import CRS, Survey
from tests.io.shared_cases import CASES, needs_cases


def georeference(*words):
    result = clsplat_("georeference", *words)
    return result.exit_code, result.output


def lines_of(survey, change=lambda *place: place, crs=CRS):
    """A file of the seven points that most photos show, with changed coordinates."""
    best = sorted(range(20, 200), key=lambda index: -len(list(survey.marks(index))))[:7]
    return "\n".join(
        [
            crs,
            *(
                " ".join(map(repr, (*map(float, change(*survey.points[index])), x, y, name, f"P{index}"))).replace(
                    "'", ""
                )
                for index in best
                for name, x, y in survey.marks(index)
            ),
        ]
    )


def test_ground_control_points_place_a_scene(tmp_path):
    (tmp_path / "gcp.txt").write_text(lines_of(Survey(tmp_path / "scene")))
    words = tmp_path / "scene", "-o", tmp_path / "out", "--gcp", tmp_path / "gcp.txt"
    name = (tmp_path / "gcp.txt").read_text().split()[-1]
    for out, used, options in (("out", 7, ()), ("other", 6, ("--check-point", name))):
        code, said = georeference(*words[:2], tmp_path / out, *words[3:], *options)
        assert code == 0 and f"by {used} ground control points: residual 0.0" in said
        assert f"{out}: {CRS}, origin at east 5876" in said
        assert ("1 check points, which took no part: residual 0.0" in said) == bool(options)
    assert (tmp_path / "out" / "sparse" / "0" / "images.bin").is_file()


def test_what_cannot_be_done_is_said_in_one_line(tmp_path):
    Survey(tmp_path / "scene")
    for words, complaint in (
        ((), "no photo has GPS; give photos with GPS (--photos), or"),
        (("--up", 0, 0, 0), "--up 0 0 0: is no direction"),
        (("--crs", "EPSG:4326"), "is not a projected coordinate reference system in metres"),
        (("--check-point", "P1"), "give their file with --gcp"),
        (("--gcp", tmp_path / "none.txt"), "none.txt: no such file"),
    ):
        code, said = georeference(tmp_path / "scene", "-o", tmp_path / "out", *words)
        assert code == 2 and complaint in said and said.count("\n") == 1
        assert [path.name for path in tmp_path.iterdir()] == ["scene"]


@needs_cases
@pytest.mark.one_in(3)
@pytest.mark.parametrize(
    "name, words, east, north, height",
    [
        ("exif_gps_whole_seconds", "GPS of 12 photos: residual 0.00 m", 326892, 4685197, 100),
        ("exif_gps_status_void", "positions of 12 photos as void; they are used", 326892, 4685198, 100),
        ("exif_altitude_zero", "residual 0.00 m along the ground, 0.02 m in h", 326892, 4685197, 100),
        ("tracks_without_observations", "write the scene anew with `clsplat pack`", 0, 0, 0),
        ("gcp/scene wkt_ft", "are taken as US survey foot, the unit of its x", 549909, 4147338, 300),
        ("gcp/scene_space spacename", "by 7 ground control points: residual 0.00", 500123, 5200451, 300),
        ("gcp/scene utm_letterband", "32U: U is a latitude band; write N or S", 0, 0, 0),
    ],
)
def test_cases_of_public_reports(tmp_path, name, words, east, north, height):
    scene, *control = name.split()
    options = [word for file in control for word in ("--gcp", CASES / "gcp" / f"{file}.txt")]
    code, said = georeference(CASES / scene, "-o", tmp_path / "out", *options)
    assert words.replace("CASE", str(CASES / scene)) in said
    assert code == (0 if east else 2)
    if east:
        known = read_scene(tmp_path / "out").georeference
        assert np.abs(np.subtract(known.offset, (east, north, height))).max() <= 2


EAST, NORTH = 587671.0, 3338100.0
REFUSED, WARNED, RIGHT = "refused", "warned", "right"
HOSTILE = [
    ("as it is", lambda x, y, z: (x, y, z), CRS, RIGHT, ""),
    ("exchanged", lambda x, y, z: (y, x, z), CRS, REFUSED, "are x and y exchanged?"),
    (
        "exchanged near",
        lambda x, y, z: (EAST + y - NORTH, NORTH + x - EAST, z),
        CRS,
        REFUSED,
        "are x and y exchanged, or has one of them the wrong sign?",
    ),
    ("east mirrored", lambda x, y, z: (2 * EAST - x, y, z), CRS, REFUSED, "the wrong sign?"),
    ("east negative", lambda x, y, z: (-x, y, z), CRS, REFUSED, "outside the area of EPSG:32614"),
    (
        "degrees",
        lambda x, y, z: (-98 + (x - EAST) * 1e-5, 30 + (y - NORTH) * 1e-5, z),
        CRS,
        REFUSED,
        "are they degrees? Then EPSG:4326",
    ),
    ("heights negative", lambda x, y, z: (x, y, -z), CRS, REFUSED, "positive downwards?"),
    ("heights in feet", lambda x, y, z: (x, y, z / 0.3048), CRS, REFUSED, "in feet?"),
    ("one line", lambda x, y, z: (x, NORTH, z), CRS, REFUSED, "contradict each other|tilted"),
    ("east lost", lambda x, y, z: (0, y, z), CRS, WARNED, ""),  # a line
    ("another zone", lambda x, y, z: (x, y, z), "EPSG:32632", RIGHT, ""),  # nothing shows it
    ("of Germany", lambda x, y, z: (x, y, z), "EPSG:25832", REFUSED, "latitude 30.2, longitude 9"),
    ("of a vertical CRS", lambda x, y, z: (x, y, z), "EPSG:32614+5773", RIGHT, "EGM96 height"),
    ("a band", lambda x, y, z: (x, y, z), "WGS84 UTM 14R", REFUSED, "R is a latitude band; write"),
]


@pytest.mark.one_in(6)
@pytest.mark.parametrize("name, change, crs, kind, words", HOSTILE, ids=[row[0] for row in HOSTILE])
def test_control_points_with_gross_errors(tmp_path, name, change, crs, kind, words):
    survey = Survey(tmp_path / "scene")
    (tmp_path / "gcp.txt").write_text(lines_of(survey, change, crs))
    code, said = georeference(tmp_path / "scene", "-o", tmp_path / "out", "--gcp", tmp_path / "gcp.txt")
    assert code == (2 if kind == REFUSED else 0) and ("warning: " in said) == (kind == WARNED)
    if kind == REFUSED:
        assert said.count("\n") == 1 and any(word in said for word in words.split("|"))
        assert {path.name for path in tmp_path.iterdir()} == {"scene", "gcp.txt"}
    elif kind == RIGHT:
        record = json.loads((tmp_path / "out" / "georeference.json").read_text())
        assert record["control_count"] == 7 and words in record["vertical"]
        assert record["control_errors"]["up"]["rms"] < 0.1
