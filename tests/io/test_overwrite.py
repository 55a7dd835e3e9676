"""--overwrite removes the run that clsplat wrote, and nobody else's files."""

import json
import os

import numpy as np
import pytest

from clsplat.errors import InputError
from clsplat.gaussians import Gaussians
from clsplat.io.atomic import replacing
from clsplat.io.runs.run import RunFolder

MODEL = Gaussians.from_points(np.eye(3), np.zeros((3, 3), np.uint8), 0)


def made(folder):
    run = RunFolder.create(folder)
    run.write_options({})
    run.log({"event": "step"})
    run.save_model(MODEL, np.zeros(3))
    return run


def overwritten(run):
    RunFolder.create(run.path, overwrite=True).write_options({})
    return {path.relative_to(run.path).as_posix() for path in run.path.rglob("*")}


@pytest.mark.parametrize("place", ["renders", "renders/test"])
def test_a_folder_that_is_a_link_is_not_followed(tmp_path, place):
    run, link, theirs = made(tmp_path / "run"), tmp_path / "run" / place, tmp_path / "theirs"
    run.renders.note("test", ["level_3.ply", "a.jpg"])
    names = ("level_3.ply.png", "a.jpg.png", "level_3.ply")
    files = [theirs / folder / name for folder in (".", "test") for name in names]
    (theirs / "test").mkdir(parents=True)
    for file in files:
        file.write_bytes(b"mine")
    if link.exists():
        os.rename(link, tmp_path / "before")
    link.symlink_to(theirs)
    run.renders.note("test", ["level_3.ply", "a.jpg"])  # through the link, as `clsplat eval` does
    overwritten(run)
    assert all(file.read_bytes() == b"mine" for file in files) and link.is_symlink()


def test_files_of_the_user_stay(tmp_path):
    run = made(tmp_path / "run")
    run.renders.note("test", ["a.jpg"])
    for name in ("a.jpg", "mine"):
        run.renders.path("test", name).write_bytes(b"png")
    (run.path / "renders" / "empty").mkdir()
    assert overwritten(run) == {"options.json", "renders", "renders/empty", "renders/test",
                                "renders/test/mine.png"}


def test_a_link_to_a_model_is_removed_and_the_model_stays(tmp_path):
    run = made(tmp_path / "run")
    os.rename(run.path / "point_cloud.ply", tmp_path / "elsewhere.ply")
    (run.path / "point_cloud.ply").symlink_to(tmp_path / "elsewhere.ply")
    assert overwritten(run) == {"options.json"}
    assert (tmp_path / "elsewhere.ply").stat().st_size > 0


@pytest.mark.parametrize("name", ["report.html", "options.json", "metrics.jsonl"])
def test_a_folder_without_a_run_is_not_overwritten(tmp_path, name):
    """Another program's files may have the same names."""
    (tmp_path / name).write_text(json.dumps({"colour": "blue"}))
    with pytest.raises(InputError, match="no run that clsplat wrote"):
        RunFolder.create(tmp_path, overwrite=True)
    assert (tmp_path / name).exists()


@pytest.mark.parametrize("damaged", ["{", ""])
def test_a_run_whose_options_are_damaged_is_overwritten(tmp_path, damaged):
    run = made(tmp_path / "run")
    (run.path / "options.json").write_text(damaged)
    assert overwritten(run) == {"options.json"}


@pytest.mark.parametrize("overwrite", [False, True])
def test_a_city_is_not_overwritten_by_a_run(tmp_path, overwrite):
    run = made(tmp_path / "run")
    (run.path / "city.json").write_text("{}")
    with pytest.raises(InputError, match="holds a city"):
        RunFolder.create(run.path, overwrite=overwrite)
    assert run.has_model


def test_partial_files_of_a_killed_process_are_replaced_and_a_link_is_not_followed(tmp_path):
    (tmp_path / "mine").write_text("mine")
    (tmp_path / "file.part").symlink_to(tmp_path / "mine")
    with replacing(tmp_path / "file") as file:
        file.write(b"new")
    assert (tmp_path / "file").read_bytes() == b"new" and not (tmp_path / "file").is_symlink()
    assert (tmp_path / "mine").read_text() == "mine"
