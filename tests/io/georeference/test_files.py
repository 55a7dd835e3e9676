"""The place and orientation of a scene on disk: read and written, damaged, and never lost."""

import json
from dataclasses import replace

import numpy as np
import pytest

from clsplat.errors import InputError
from clsplat.evaluation.run import Run
from clsplat.georeference import Georeference, Residual
from clsplat.io.georeference import files
from clsplat.io.models.ply import read_ply, read_vertices, write_ply
from clsplat.io.runs.run import RunFolder
from clsplat.io.scenes.read import read_scene
from tests.data.fields import field
from tests.data.tiny_model import write_scene
from tests.io.models.test_ply import random_gaussians

HERE = Georeference(
    "EPSG:32614",
    (587671.0, 3338100.0, 309.0),
    "GPS of 40 photos",
    1.25,
    "gps",
    200.0,
    "ellipsoidal heights",
    (
        Residual("a.jpg", "control", 1.0, -2.0, None),
        Residual("b.jpg", "control", 3.0, 2.0, 0.5),
        Residual("c.jpg", "left out", 90.0, 0.0, 0.0, 7.5),
    ),
    ("Look.",),
)


def test_a_georeference_is_read_as_it_was_written(tmp_path):
    assert files.read_georeference(tmp_path) is None
    files.write_georeference(tmp_path, HERE)
    assert files.read_georeference(tmp_path) == HERE
    assert HERE.to_map([[1, 2, 3]]).tolist() == [[587672, 3338102, 312]]
    files.write_georeference(tmp_path, None)
    assert files.read_georeference(tmp_path) is None


def test_a_georeference_states_its_errors_for_other_programs(tmp_path):
    files.write_georeference(tmp_path, HERE)
    record = json.loads((tmp_path / files.GEOREFERENCE).read_text())
    assert (record["control_count"], record["check_count"], record["left_out"]) == (2, 0, ["c.jpg"])
    assert record["control_errors"]["east"] == {"mean": 2, "sigma": 1, "rms": 2.2361, "within_90": 2.8}
    assert record["control_errors"]["up"]["rms"] == 0.5 and record["check_errors"] == {}
    old = {key: record[key] for key in ("crs", "offset", "source", "residual")}
    (tmp_path / files.GEOREFERENCE).write_text(json.dumps(old))
    assert files.read_georeference(tmp_path) == Georeference(HERE.crs, HERE.offset, HERE.source, 1.25)


def test_an_orientation_is_read_as_it_was_written(tmp_path):
    assert files.read_orientation(tmp_path) is None
    scene = field().recentred()
    files.write_orientation(tmp_path, [0, 0, 2], scene.first_view)
    up, view = files.read_orientation(tmp_path)
    assert up.tolist() == [0, 0, 1]
    assert np.allclose(view.position, scene.first_view.position + scene.offset)
    assert np.allclose(view.rotation, scene.first_view.rotation)
    files.write_orientation(tmp_path, [0, 1, 0])
    assert files.read_orientation(tmp_path)[1] is None


@pytest.mark.parametrize(
    "name, key, value",
    [
        (files.GEOREFERENCE, "crs", ""),
        (files.GEOREFERENCE, "crs", "EPSG:1\nEPSG:2"),
        (files.GEOREFERENCE, "crs", 5),
        (files.GEOREFERENCE, "offset", [1, 2]),
        (files.GEOREFERENCE, "offset", [1, 2, "3"]),
        (files.GEOREFERENCE, "source", None),
        (files.GEOREFERENCE, "size", "5"),
        (files.GEOREFERENCE, "residuals", [5]),
        (files.GEOREFERENCE, "residuals", [{"east": 1}]),
        (files.GEOREFERENCE, "warnings", "Look."),
        (files.ORIENTATION, "up", [0, 0, 0]),
        (files.ORIENTATION, "up", "z"),
        (files.ORIENTATION, "first_view", 3),
        (files.ORIENTATION, "first_view", {"width": 5}),
    ],
)
def test_damaged_files_are_named(tmp_path, name, key, value):
    files.write_georeference(tmp_path, HERE)
    files.write_orientation(tmp_path, [0, 0, 1], field().first_view)
    read = files.read_georeference if name == files.GEOREFERENCE else files.read_orientation
    record = json.loads((tmp_path / name).read_text())
    (tmp_path / name).write_text(json.dumps({**record, key: value}))
    with pytest.raises(InputError, match=f"{name}: not a record"):
        read(tmp_path)
    (tmp_path / name).write_text("{")
    with pytest.raises(InputError, match=f"{name}: not a record"):
        read(tmp_path)


def test_comments_of_a_model_name_its_place(tmp_path):
    gaussians = random_gaussians()
    write_ply(tmp_path / "a.ply", gaussians, (1.0, 2.0, 3.0), files.placement_comments([0.0, 0.01, 0.99995], HERE))
    comments = read_vertices(tmp_path / "a.ply")[1]
    assert files.commented_georeference(comments) == Georeference(
        HERE.crs, HERE.offset, "comments of the model's file", 0.0
    )
    text = "\n".join(comments)
    assert "\ncrs EPSG:32614\n" in text and "\nVertical Axis: z\n" in text
    assert "\nmap_offset 587671.0 3338100.0 309.0 is not contained in the positions" in text
    assert not any(comment.startswith("offset") for comment in comments)
    # the offset of the map is not subtracted from the positions, that of the local frame is
    assert read_ply(tmp_path / "a.ply").offset.tolist() == [1, 2, 3]
    assert files.commented_georeference(files.placement_comments([0, -1, 0])) is None
    odd = replace(HERE, crs='PROJCRS["Zone 1 \u2013 \\ S\u00fcd"]')
    assert files.commented_georeference(files.placement_comments([0, 0, 1], odd)).crs == odd.crs


def test_the_offset_of_older_files_is_still_read(tmp_path):
    write_ply(tmp_path / "a.ply", random_gaussians(), (1.0, 2.0, 3.0))
    content = (tmp_path / "a.ply").read_bytes()
    (tmp_path / "b.ply").write_bytes(content.replace(b"positions are centred near", b"offset"))
    old, new = read_ply(tmp_path / "b.ply"), read_ply(tmp_path / "a.ply")
    assert old.offset.tolist() == new.offset.tolist() == [1, 2, 3]
    assert np.array_equal(old.positions, new.positions)


def test_scenes_keep_their_place(tmp_path):
    write_scene(tmp_path / "scene")
    plain = read_scene(tmp_path / "scene")
    assert plain.georeference is None and plain.given_up is None
    files.write_georeference(tmp_path / "scene", HERE)
    files.write_orientation(tmp_path / "scene", [0, 3, 4])
    scene = read_scene(tmp_path / "scene")
    assert scene.georeference == HERE and scene.up.tolist() == [0, 0.6, 0.8]
    for other in (scene.part([0, 1]), scene.reduced(2), scene.recentred(), scene.normalised()):
        assert other.georeference == HERE and other.up.tolist() == [0, 0.6, 0.8]


def test_a_run_keeps_what_its_model_needs_of_the_scene(tmp_path):
    write_scene(tmp_path / "scene")
    scene = replace(read_scene(tmp_path / "scene"), georeference=HERE)
    folder = RunFolder.create(tmp_path / "run")
    folder.write_options({"scene": tmp_path / "scene"})
    files.write_placement(folder.path, scene, first_view=True)
    run = Run.open(tmp_path / "run")
    assert run.georeference == HERE and run.up.tolist() == [0, 0, 1]
    assert np.allclose(run.first_view.position, scene.first_view.position + scene.offset)
    files.write_placement(folder.path, replace(scene, georeference=None).with_up([0, -1, 0]))
    assert run.georeference is None and run.up.tolist() == [0, -1, 0]
    assert run.scene().up.tolist() == [0, -1, 0]  # what the user gave outlives the scene's estimate
    (tmp_path / "run" / files.ORIENTATION).unlink()  # as in a run of an older version
    assert np.allclose(run.first_view.position, run.scene().first_view.position + scene.offset)
