"""Whatever a user hands in, the answer is one line that names the file and the cure, never a crash.

Each case spoils a healthy scene or run in one way and says what the line must contain. What the
unit tests of clsplat/io check in depth is checked here once for the whole way in.
"""

import shutil
import subprocess
import sys

import numpy as np
import pytest

from clsplat.errors import InputError
from clsplat.gaussians import Gaussians
from clsplat.io.images import read_image, write_image
from clsplat.io.ply import read_ply
from clsplat.io.run import RunFolder
from clsplat.io.scenes import read_scene
from tests.tiny_model import HEIGHT, WIDTH, reconstruction, write_scene


def cut(path, share):
    data = path.read_bytes()
    path.write_bytes(data[:int(len(data) * share)])


def moved(made, move):
    for point in made.points3D.values():
        point.xyz = move(point.xyz)
    return made


# name -> (spoils a scene folder, words of the line)
SCENES = {
    "no model": (lambda f: shutil.rmtree(f / "sparse"), ("town", "no COLMAP model", "clsplat sfm")),
    "no photos": (lambda f: shutil.rmtree(f / "images"), ("photo_0.png", "4 of 4")),
    "photo missing": (lambda f: (f / "images/photo_2.png").unlink(), ("photo_2.png", "1 of 4")),
    "photo is text": (lambda f: (f / "images/photo_2.png").write_text("hi"), ("photo_2.png",)),
    "cameras cut": (lambda f: cut(f / "sparse/0/cameras.bin", 0.7), ("cameras.bin", "cut short")),
    "images cut": (lambda f: cut(f / "sparse/0/images.bin", 0.7), ("images.bin", "cut short")),
    "points cut": (lambda f: cut(f / "sparse/0/points3D.bin", 0.7), ("points3D.bin", "cut short")),
    "points swapped": (lambda f: shutil.copy(f / "sparse/0/images.bin",
                                             f / "sparse/0/points3D.bin"), ("sparse/0",)),
    "frames cut": (lambda f: cut(f / "sparse/0/frames.bin", 0.5), ("sparse/0", "damaged")),
}


@pytest.mark.parametrize("case", SCENES)
def test_spoilt_scene(tmp_path, case):
    spoil, words = SCENES[case]
    folder = write_scene(tmp_path / "town")
    spoil(folder)
    with pytest.raises(InputError) as caught:
        read_scene(folder)
    message = str(caught.value)
    assert "\n" not in message and ";" in message
    for word in words:
        assert word in message, message


def test_spoilt_scene_in_a_process_of_its_own(tmp_path):
    """pycolmap's abort must not reach whoever asked."""
    folder = write_scene(tmp_path / "town")
    cut(folder / "sparse/0/frames.bin", 0.5)
    code = ("from clsplat.io.scenes import read_scene\n"
            f"try:\n    read_scene({str(folder)!r})\nexcept Exception as e:\n    print(repr(e))")
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60,
                          check=True)
    assert done.stdout.startswith("InputError(") and done.stderr == ""


def test_large_coordinates_keep_their_digits(tmp_path):
    utm = np.array([512345.678, 5212345.123, 431.5])
    plain = read_scene(write_scene(tmp_path / "plain"))
    folder = write_scene(tmp_path / "far", moved(reconstruction(), lambda x: x + utm))
    far = read_scene(folder)
    assert np.abs(far.points - plain.points).max() < 1e-8
    assert np.abs(far.offset - plain.offset - utm).max() < 1e-8


def test_a_photo_cut_short_is_refused_when_its_pixels_are_read(tmp_path):
    folder = write_scene(tmp_path / "town")
    noise = np.random.default_rng(0).integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)
    write_image(folder / "images/photo_1.png", noise)
    cut(folder / "images/photo_1.png", 0.6)
    scene = read_scene(folder)  # headers are whole
    with pytest.raises(InputError, match="photo_1.png"):
        read_image(scene.views[1].source)


def test_spoilt_run(tmp_path):
    run = RunFolder.create(tmp_path / "run")
    run.write_options({"scene": "town"})
    run.save_checkpoint({"a": np.arange(999.0)}, {"iteration": 3})
    run.save_model(Gaussians.from_points(np.eye(3), np.zeros((3, 3), np.uint8)), np.zeros(3))
    for name, read in (("options.json", run.read_options), ("checkpoint.npz", run.load_checkpoint),
                       ("point_cloud.ply", run.load_model)):
        cut(run.path / name, 0.6)
        with pytest.raises(InputError, match=name) as caught:
            read()
        assert "\n" not in str(caught.value) and ";" in str(caught.value)


def test_files_of_the_wrong_kind(tmp_path):
    for name in ("a.npz", "a.ply", "a.txt"):
        (tmp_path / name).write_bytes(bytes(range(256)) * 4)
    for read, name in ((read_scene, "a.npz"), (read_scene, "a.txt"), (read_ply, "a.ply"),
                       (read_image, "a.txt"), (RunFolder.create, "a.txt"),
                       (RunFolder.open, "a.txt")):
        with pytest.raises(InputError, match=name) as caught:
            read(tmp_path / name)
        assert "\n" not in str(caught.value) and ";" in str(caught.value)
