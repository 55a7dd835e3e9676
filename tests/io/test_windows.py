"""Files and paths as programs on Windows write them: lines that end with CRLF, drives, backslashes.

What needs Windows itself is not tested here.
"""

import numpy as np
import pytest

from clsplat.io.models.ply import read_vertices
from clsplat.io.photos.mrk import with_mrk
from clsplat.io.runs.run import RunFolder
from clsplat.io.scenes.read import read_scene
from clsplat.io.scenes.transforms import _photo
from tests.data.layouts import assert_same
from tests.data.projects import write_opensfm
from tests.data.tiny_model import reconstruction, write_scene
from tests.io.photos.test_mrk import AT, LINE


def as_windows(folder, pattern):
    """Give all text files of a folder the line ends of Windows."""
    files = list(folder.rglob(pattern))
    assert files
    for file in files:
        data = file.read_bytes()
        assert b"\n" in data and b"\r" not in data
        file.write_bytes(data.replace(b"\n", b"\r\n"))


def test_a_text_model_of_colmap(tmp_path):
    made = reconstruction()
    scene = read_scene(write_scene(tmp_path / "town", made, True))
    as_windows(tmp_path / "town", "*.txt")
    read = read_scene(tmp_path / "town")
    assert_same(read, scene)
    assert np.array_equal(read.observations, scene.observations)


def test_a_project_of_opensfm(tmp_path):
    scene = read_scene(write_scene(tmp_path / "town", reconstruction()))
    write_opensfm(tmp_path / "project", scene)
    as_windows(tmp_path / "project", "tracks.csv")
    read = read_scene(tmp_path / "project")
    assert_same(read, scene)
    assert np.array_equal(read.observations, scene.observations)


def test_positions_of_dji(tmp_path):
    (tmp_path / "100_0034_Timestamp.MRK").write_bytes(LINE.format(3, 51.10001, 50).replace("\n", "\r\n").encode())
    [found], _ = with_mrk([(tmp_path / "100_0034_0003.JPG", AT)])
    assert found.latitude == 51.10001


@pytest.mark.parametrize("end", ["\n", "\r\n"], ids=repr)
def test_points_in_an_ascii_ply(tmp_path, end):
    lines = [
        "ply",
        "format ascii 1.0",
        "element vertex 2",
        "property float x",
        "property float y",
        "property float z",
        "end_header",
        "1 2 3",
        "4 5 6.5",
    ]
    (tmp_path / "a.ply").write_bytes((end.join(lines) + end).encode())
    assert read_vertices(tmp_path / "a.ply")[0]["z"].tolist() == [3, 6.5]


def test_metrics_that_an_editor_saved(tmp_path):
    run = RunFolder.create(tmp_path / "run")
    run.log({"event": "plan"})
    run.log({"event": "step"})
    as_windows(run.path, "metrics.jsonl")
    assert [record["event"] for record in run.records()] == ["plan", "step"]


@pytest.mark.parametrize(
    "path, name",
    [
        (r"photos\a.png", "photos/a.png"),
        (r"C:\photos\a.png", "photos/a.png"),
        (r"..\photos\a.png", "photos/a.png"),
        ("d:/a.png", "a.png"),
        (r"\\server\share\a.png", "server/share/a.png"),
        ("/home/a.png", "home/a.png"),
    ],
)
def test_the_name_of_a_view_leaves_no_folder(tmp_path, path, name):
    """A picture is written under it."""
    assert _photo(tmp_path, path)[0] == name
