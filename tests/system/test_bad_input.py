"""Whatever a user hands in, the answer is one line that names the file and the cure, never a crash.

Each case spoils a healthy scene or run in one way and says what the line must contain. What the
unit tests of clsplat/io check in depth is checked here once for the whole way in.
"""

import os
import shutil
import subprocess
import sys

import numpy as np
import pytest

from clsplat.io.photos.images import write_image
from clsplat.io.scenes.colmap_files import write_colmap
from clsplat.io.scenes.read import read_scene
from tests.command_line import clsplat_
from tests.data.tiny_model import HEIGHT, WIDTH, reconstruction, write_scene

TRAIN = ("-q", "-n", "3", "--test-every", "4", "--sh-degree", "0")
NOISE = np.random.default_rng(0).integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)


def cut(path, share):
    data = path.read_bytes()
    path.write_bytes(data[: int(len(data) * share)])


def moved(made, move):
    for point in made.points3D.values():
        point.xyz = move(point.xyz)
    return made


def single_photo(folder):
    scene = read_scene(folder)
    shutil.rmtree(folder / "sparse")
    write_colmap(folder / "sparse/0", scene.views[:1], scene.points, scene.colours)


def left(count, made):
    for number in list(made.points3D)[count:]:
        made.delete_point3D(number)
    return made


def rewrite(made):
    return lambda folder: write_scene(folder, made())


def noise_cut(name):
    """One photo of detail, cut short: its header is whole."""

    def spoil(folder):
        write_image(folder / "images" / name, NOISE)
        cut(folder / "images" / name, 0.6)

    return spoil


# name -> (spoils a scene folder, words of the line)
SCENES = {
    "no photos": (lambda f: shutil.rmtree(f / "images"), ("photo_0.png", "4 of 4")),
    "single photo": (single_photo, ("town", "single photo", "at least two")),
    "photo cut": (noise_cut("photo_2.png"), ("photo_2.png", "cut short", "copy it again")),
    "held-out photo cut": (noise_cut("photo_0.png"), ("photo_0.png", "cut short")),
    "points cut": (lambda f: cut(f / "sparse/0/points3D.bin", 0.7), ("points3D.bin", "cut short")),
    "points swapped": (lambda f: shutil.copy(f / "sparse/0/images.bin", f / "sparse/0/points3D.bin"), ("sparse/0",)),
    "zero points": (rewrite(lambda: left(0, reconstruction())), ("sparse/0", "no points")),
    "points equal": (
        rewrite(lambda: moved(reconstruction(), lambda x: np.ones(3))),
        ("sparse/0", "30 points all lie at one place"),
    ),
    "points not a number": (
        rewrite(lambda: moved(reconstruction(), lambda x: x * np.nan)),
        ("sparse/0", "30 of 30 points are not finite"),
    ),
    "distorted camera": (
        rewrite(lambda: reconstruction("SIMPLE_RADIAL", (50.0, 24.0, 18.0, 1e9))),
        ("sparse/0", "cannot be undistorted", "SIMPLE_RADIAL"),
    ),
}


def refused(*words, naming):
    """Run a command that must end in one line with these words, and exit code 2."""
    result = clsplat_(*words)
    assert result.exit_code == 2, result.output
    (line,) = result.output.splitlines()
    assert line.startswith("error: ")
    for word in naming:
        assert word in line, line
    return line


@pytest.fixture(scope="module")
def healthy(tmp_path_factory):
    """A scene folder; not to be changed."""
    return write_scene(tmp_path_factory.mktemp("healthy") / "town")


@pytest.fixture(scope="module")
def finished(healthy, tmp_path_factory):
    """The folder of a run on it; not to be changed."""
    folder = tmp_path_factory.mktemp("finished") / "run"
    result = clsplat_("train", healthy, "-o", folder, *TRAIN)
    assert result.exit_code == 0, result.output
    return folder


def content(folder):
    return {path.name: path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.mark.one_in(6)
@pytest.mark.parametrize("case", SCENES)
def test_spoilt_scene(tmp_path, case):
    spoil, words = SCENES[case]
    folder = write_scene(tmp_path / "town")
    spoil(folder)
    line = refused("train", folder, "-o", tmp_path / "run", *TRAIN, naming=words)
    assert ";" in line, "a cause and a cure"
    assert not content(tmp_path / "run"), "nothing half written"


@pytest.mark.parametrize("parent", ["a file", "/proc"])
def test_output_that_cannot_be_written(tmp_path, healthy, parent):
    """Root may write anywhere but there."""
    (tmp_path / "a file").write_text("mine")
    output = tmp_path / parent / "run"
    line = refused("train", healthy, "-o", output, *TRAIN, naming=(str(output), "--output"))
    assert ";" in line
    assert (tmp_path / "a file").read_text() == "mine"


def test_output_that_is_a_run(healthy, finished):
    before = content(finished)
    refused("train", healthy, "-o", finished, *TRAIN, naming=(str(finished), "--resume", "--overwrite"))
    assert content(finished) == before


def test_overwriting_waits_until_all_is_in_order(healthy, finished):
    before = content(finished)
    refused(
        "train", healthy, "-o", finished, *TRAIN, "--overwrite", "--max-gaussians", "5", naming=("--max-gaussians 5",)
    )
    assert content(finished) == before


@pytest.mark.parametrize(
    "words, naming",
    [
        (("--init", "nowhere.ply"), ("nowhere.ply", "no such file")),
        (("--max-gaussians", "5"), ("--max-gaussians 5", "30", "allow")),
        (("--test-every", "1"), ("--test-every 1", "use a larger number")),
        (("--test-offset", "4"), ("--test-offset 4", "must be less than --test-every, which is 4")),
        (("--test-every", "none", "--test-offset", "1"), ("--test-offset 1", "which is none")),
        (
            ("--test-every", "900", "--test-offset", "800"),
            ("--test-offset 800", "holds out none of its", "use a smaller number"),
        ),
        (("--device", "warp drive"), ("warp drive", "clsplat devices")),
        (("--sh-degree", "4"), ("sh-degree", "from 0 to 3")),
        (
            ("--levels", "4", "--levels", "1"),
            ("--levels: level 4", "12 x 9 pixels", "tile of 16", "give smaller --levels"),
        ),
    ],
)
@pytest.mark.one_in(9)
def test_options_that_cannot_be_met(tmp_path, healthy, finished, words, naming):
    """Neither a new run is begun nor one that is there touched."""
    refused("train", healthy, "-o", tmp_path / "run", *TRAIN, *words, naming=naming)
    assert not content(tmp_path / "run")
    before = content(finished)
    refused("train", healthy, "-o", finished, *TRAIN, *words, "--overwrite", naming=naming)
    assert content(finished) == before


@pytest.mark.slow
def test_no_working_device(tmp_path, healthy):
    """The loader is shown an empty folder of drivers."""
    (tmp_path / "vendors").mkdir()
    done = subprocess.run(
        [sys.executable, "-m", "clsplat", "train", str(healthy), "-o", str(tmp_path / "run"), *TRAIN],
        env={**os.environ, "OCL_ICD_VENDORS": str(tmp_path / "vendors")},
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )
    assert done.returncode == 2 and done.stdout == ""
    (line,) = done.stderr.splitlines()
    assert line.startswith("error: no working OpenCL device; install")
    assert "pip install intel-opencl-rt" in line and "pocl-opencl-icd" in line
    assert not (tmp_path / "run").exists()


@pytest.mark.slow
def test_resuming_what_cannot_be(tmp_path, healthy, finished):
    run = tmp_path / "run"
    resume = ("train", healthy, "-o", run, "-q", "--resume")
    refused(*resume, naming=(str(run), "holds no run"))
    shutil.copytree(finished, run)
    other = write_scene(tmp_path / "village", moved(reconstruction(), lambda x: 2 * x))
    refused("train", other, "-o", run, "-q", "--resume", naming=(str(run), "another scene", str(healthy), "--output"))
    cut(run / "checkpoint.npz", 0.9)
    spoilt = content(run)
    refused(*resume, naming=("checkpoint.npz", "cut short", "--overwrite"))
    assert content(run) == spoilt
    (run / "checkpoint.npz").unlink()
    refused(*resume, naming=("checkpoint.npz", "no checkpoint"))
