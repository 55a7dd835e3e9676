"""`clsplat georeference`: what it says, and what it refuses."""

from click.testing import CliRunner

from clsplat.cli.main import main
from tests.data.survey import CRS, Survey


def georeference(*words):
    result = CliRunner().invoke(main, ["georeference", *map(str, words)])
    return result.exit_code, result.output


def control_points(survey, path):
    """Write a file of the five points that most photos show."""
    best = sorted(range(20, 200), key=lambda index: -len(list(survey.marks(index))))[:5]
    lines = [" ".join(map(repr, (*survey.points[index].tolist(), x, y))) + f" {name} P{index}"
             for index in best for name, x, y in survey.marks(index)]
    path.write_text("\n".join([CRS, *lines]))


def test_ground_control_points_place_a_scene(tmp_path):
    survey = Survey(tmp_path / "scene")
    control_points(survey, tmp_path / "gcp.txt")
    code, said = georeference(tmp_path / "scene", "-o", tmp_path / "out", "--gcp",
                              tmp_path / "gcp.txt")
    assert code == 0 and "georeferenced by 5 ground control points: residual 0.0" in said
    assert f"out: {CRS}, origin at east 5876" in said
    assert (tmp_path / "out" / "sparse" / "0" / "images.bin").is_file()


def test_check_points_are_reported(tmp_path):
    survey = Survey(tmp_path / "scene")
    control_points(survey, tmp_path / "gcp.txt")
    name = (tmp_path / "gcp.txt").read_text().split()[-1]
    code, said = georeference(tmp_path / "scene", "-o", tmp_path / "out", "--gcp",
                              tmp_path / "gcp.txt", "--check-point", name)
    assert code == 0 and "georeferenced by 4 ground control points" in said
    assert "1 check points, which took no part: residual 0.0" in said


def test_what_cannot_be_done_is_said_in_one_line(tmp_path):
    Survey(tmp_path / "scene")
    for words, complaint in (
            ((), "no photo has GPS; give photos with GPS (--photos), or"),
            (("--up", 0, 0, 0), "--up 0 0 0: is no direction"),
            (("--crs", "EPSG:4326"), "is not a projected coordinate reference system in metres"),
            (("--check-point", "P1"), "give their file with --gcp"),
            (("--gcp", tmp_path / "none.txt"), "none.txt: no such file")):
        code, said = georeference(tmp_path / "scene", "-o", tmp_path / "out", *words)
        assert code == 2 and complaint in said and said.count("\n") == 1
        assert [path.name for path in tmp_path.iterdir()] == ["scene"]
