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
def test_a_folder_of_pictures_that_is_a_link_is_not_followed(tmp_path, place):
    run, link, theirs = made(tmp_path / "run"), tmp_path / "run" / place, tmp_path / "theirs"
    (theirs / "test").mkdir(parents=True)
    link.parent.mkdir(exist_ok=True)
    link.symlink_to(theirs)
    run.picture("a.jpg").write_bytes(b"mine")
    overwritten(run)
    assert [path.read_bytes() for path in theirs.rglob("a.jpg.png")] == [b"mine"]
    assert link.is_symlink()


def test_files_beside_those_of_the_run_stay(tmp_path):
    run = made(tmp_path / "run")
    run.picture("a.jpg").write_bytes(b"png")
    (run.path / "renders" / "mine").mkdir()
    assert overwritten(run) == {"options.json", "renders", "renders/mine"}


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
