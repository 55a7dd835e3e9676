"""Films and their camera paths."""

import json
from types import SimpleNamespace

import numpy as np
import pytest

from clsplat.apps.camera_path import flight, interpolated, read_camera_path, turntable
from clsplat.evaluation.run import Run
from clsplat.io.photos.images import read_image
from clsplat.options import TrainOptions
from tests.command_line import clsplat_
from tests.data import ground_model as made
from tests.refusals import refused

SIZE = (64, 48)


def cameras_of(keys, count=50, degrees=50.0):
    return interpolated(keys, np.linspace(0, 1, count), SIZE, degrees)


def test_a_flight_passes_near_the_photos_without_jumps():
    scene = made.scene(None)
    keys = flight(scene, 60)
    positions = np.array([view.camera.position for view in scene.views]) + made.OFFSET
    assert (np.diff(keys.times) > 0).all()
    assert abs(keys.positions[[0, -1]] - positions[[0, -1]]).max() < 6
    cameras = cameras_of(keys, 200)
    path = np.array([camera.position for camera in cameras])
    steps = np.linalg.norm(np.diff(path, axis=0), axis=1)
    assert abs(steps / np.median(steps) - 1).max() < 0.1
    assert np.allclose(path[[0, -1]], keys.positions[[0, -1]])
    for camera in cameras:
        assert np.allclose(camera.rotation @ camera.rotation.T, np.eye(3))
        assert camera.rotation[2] @ (0, 0, -1) > 0.99  # looks down, as the photos do


def test_a_turntable_looks_at_the_middle_from_all_sides():
    scene = made.scene(None)
    middle = np.median(scene.points, axis=0) + made.OFFSET
    cameras = cameras_of(turntable(scene), 37)
    away = np.array([camera.position for camera in cameras]) - middle
    assert np.allclose(np.linalg.norm(away, axis=1), np.linalg.norm(away[0]), rtol=2e-2)
    elevation = np.degrees(np.arcsin(away[:, 2] / np.linalg.norm(away, axis=1)))
    assert abs(elevation - 55).max() < 1.5  # the photos look straight down: as steep as it gets
    assert np.allclose(away[:-1].mean(axis=0)[:2], 0, atol=0.3)
    for camera in cameras:
        pixel, depth = camera.project(middle[None])
        assert depth[0] > 0 and abs(pixel[0] - np.array(SIZE) / 2).max() < 1
        assert camera.rotation[1] @ (0, 0, 1) < -0.5  # upright


def camera_path(tmp_path, *frames, **more):
    path = tmp_path / "path.json"
    path.write_text(json.dumps({"frames": list(frames), **more}))
    return path


def opengl(position, **more):
    """A key that looks along -z, right x and up y."""
    return {
        "transform_matrix": [[1, 0, 0, position[0]], [0, 1, 0, position[1]], [0, 0, 1, position[2]], [0, 0, 0, 1]],
        **more,
    }


def test_a_camera_path_is_read(tmp_path):
    path = camera_path(
        tmp_path,
        opengl((1, 2, 3), time=10),
        opengl((1, 2, 5), time=11),
        opengl((1, 2, 9), time=15, camera_angle_x=0.5),
        camera_angle_x=1.0,
    )
    keys = read_camera_path(path)
    assert np.allclose(keys.times, [0, 0.2, 1]) and np.allclose(keys.positions[2], (1, 2, 9))
    assert np.allclose(keys.rotations[0], np.diag([1, -1, -1]))
    assert np.allclose(np.radians(keys.degrees), [1, 1, 0.5])
    cameras = cameras_of(keys, 11)
    assert np.allclose(cameras[2].position, (1, 2, 5))
    assert cameras[0].focal[0] == pytest.approx(32 / np.tan(0.5))
    alone = cameras_of(read_camera_path(camera_path(tmp_path, opengl((1, 2, 3)))), 3, 90)
    assert np.allclose(alone[2].position, (1, 2, 3)) and alone[0].focal[0] == pytest.approx(32)


@pytest.mark.parametrize(
    "frames, more",
    [
        ([], {}),
        ([{}], {}),
        ([3], {}),
        ([opengl((1, 2, float("nan")))], {}),
        ([{"transform_matrix": [[1, 2], [3, 4]]}], {}),
        ([{"transform_matrix": np.zeros((4, 4)).tolist()}], {}),
        ([{"transform_matrix": np.diag([1, 1, -1, 1]).tolist()}], {}),
        ([opengl((1, 2, 3), time=1), opengl((1, 2, 3), time=1)], {}),
        ([opengl((1, 2, 3), time=1), opengl((1, 2, 4))], {}),
        ([opengl((1, 2, 3))], {"camera_angle_x": 4}),
        ([opengl((1, 2, 3))], {"camera_angle_x": "a"}),
        ([opengl((1, 2, 3))], {"fl_x": 0, "w": 100}),
        ([opengl((1, 2, 10**400))], {}),
    ],
)
def test_a_damaged_camera_path_is_refused(tmp_path, frames, more):
    refused(lambda: read_camera_path(camera_path(tmp_path, *frames, **more)), "not a camera path")
    refused(lambda: read_camera_path(tmp_path / "none.json"), "none.json")


@pytest.fixture
def command(tmp_path, monkeypatch):
    """Runs `clsplat film` on the made-up scene."""
    scene = made.scene(None)
    run = SimpleNamespace(
        path=tmp_path, finished_model=made.model(), options=TrainOptions(), scene=lambda _=None: scene, up=scene.up
    )
    monkeypatch.setattr(Run, "open", lambda path: run)

    def run_film(output, *words):
        result = clsplat_("film", "run", "-o", tmp_path / output, "--size", "64x48", "--fps", 5, "--seconds", 1, *words)
        return result.exit_code, result.output

    return run_film


@pytest.mark.slow
def test_frames_as_pictures(tmp_path, command):
    (tmp_path / "frames").mkdir()
    mine = ["frame_1_mine.png", "mine.txt"]
    for name in mine:
        (tmp_path / "frames" / name).write_text("mine")
    path = camera_path(tmp_path, opengl((100, -50, 20)), opengl((100, -50, 16)))
    code, said = command("frames", "--path", str(path), "--fov", "60")
    assert code == 0, said
    names = [f"frame_{number:05d}.png" for number in range(1, 6)]
    assert sorted(each.name for each in (tmp_path / "frames").iterdir()) == [*names, *mine]
    first, last = (read_image(tmp_path / "frames" / name) for name in (names[0], names[-1]))
    blue = [(image[..., 2] > image[..., 0]).sum() for image in (first, last)]
    assert first.shape == (48, 64, 3) and 300 < blue[0] < blue[1]  # the house comes nearer
    code, said = command("frames")
    assert code == 2 and "--overwrite" in said
    code, said = command("frames", "--overwrite", "--seconds", "0.4")
    assert code == 0
    assert sorted(each.name for each in (tmp_path / "frames").iterdir()) == [*names[:2], *mine]


@pytest.mark.slow
def test_a_film(tmp_path, command):
    av = pytest.importorskip("av", reason="av is not installed (extra film)")
    for name in ("film.mp4", "film.mkv"):
        code, said = command(name, "--path", "turntable")
        assert code == 0 and "5 frames" in said, said
        with av.open(str(tmp_path / name)) as container:
            stream = container.streams.video[0]
            assert stream.codec_context.name == "h264" and stream.pix_fmt == "yuv420p"
            assert stream.average_rate == 5
            pictures = [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]
        assert len(pictures) == 5 and pictures[0].shape == (48, 64, 3)
    command("frames", "--path", "turntable")
    expected = read_image(tmp_path / "frames" / "frame_00003.png").astype(float)
    middle = np.s_[22:26, 30:34]  # of the roof: colours come back as they were
    assert abs(pictures[2][middle].mean((0, 1)) - expected[middle].mean((0, 1))).max() < 6
    code, said = command("film.mp4")
    assert code == 2 and "--overwrite" in said


@pytest.mark.parametrize(
    "words, message",
    [
        (("film.avi",), "unknown suffix"),
        (("film.mp4", "--size", "63x48"), "even numbers"),
        (("film.mp4", "--size", "63"), "not a size"),
        (("film.mp4", "--path", "none.json"), "none.json"),
        (("film.mp4", "--host-memory", "64"), "--host-memory: has no effect on run, which is no city"),
    ],
)
def test_wrong_words_get_a_line(tmp_path, command, words, message):
    pytest.importorskip("av", reason="av is not installed (extra film)")
    code, said = command(*words)
    assert code == 2 and message in said, said
    assert not list(tmp_path.iterdir())
