"""Models with numbers that are not finite: what these mean, and which rows are left out."""

import logging

import numpy as np
import plyfile
import pytest

from clsplat.errors import InputError
from clsplat.io.models.formats import read_model, write_model
from clsplat.io.models.ply import read_ply, write_ply
from tests.io.models.test_ply import random_gaussians


def changed(path, column, values):
    """A PLY of six gaussians, whose first rows have these values in a column."""
    write_ply(path, random_gaussians(6, 1))
    table = np.array(plyfile.PlyData.read(path)["vertex"].data)
    table[column][:len(values)] = values
    plyfile.PlyData([plyfile.PlyElement.describe(table, "vertex")]).write(path)
    return path


@pytest.mark.parametrize("suffix", [".ply", ".sog", ".spz", ".glb"])
def test_infinite_opacities_and_scales_can_be_written_again(tmp_path, suffix):
    path = changed(tmp_path / "a.ply", "opacity", [np.inf, -np.inf])
    model = read_model(path)
    assert model.count == 6 and model.opacity_logits[0] > 16 and model.opacity_logits[1] < -60
    model = read_model(changed(tmp_path / "b.ply", "scale_1", [-np.inf]))
    assert model.count == 6 and model.log_scales[0, 1] == -80
    write_model(tmp_path / f"c{suffix}", model)
    assert read_model(tmp_path / f"c{suffix}").count == 6


@pytest.mark.parametrize("column, values", [
    ("y", [np.inf, -np.inf]), ("opacity", [np.nan]), ("scale_0", [np.inf])])
def test_rows_without_a_meaning_are_left_out_and_counted(tmp_path, caplog, column, values):
    path = changed(tmp_path / "a.ply", column, values)
    model, whole = read_model(path), random_gaussians(6, 1)
    for name, rows in model.rows.items():
        assert np.array_equal(rows, whole.rows[name][len(values):])
    assert [record.getMessage() for record in caplog.records] == [
        f"{path}: {len(values)} of 6 rows hold numbers that are not finite: they are left out"]
    with pytest.raises(InputError, match=f"{len(values)} of 6 rows .* not finite"):
        read_ply(path)  # as a run's own model


def test_a_file_of_mostly_such_rows_is_damaged(tmp_path, caplog):
    path = changed(tmp_path / "a.ply", "rot_0", 4 * [np.nan])
    with pytest.raises(InputError, match=r"a\.ply: 4 of 6 rows .* 4 of them in quaternions"):
        read_model(path)
    assert not caplog.records


def test_points_of_a_cloud_are_left_out_as_well(tmp_path, caplog):
    points = np.array([(x, 1.0, 2.0) for x in range(8)], [(name, "f8") for name in "xyz"])
    points["z"][[1, 5]] = np.nan, 1e300
    plyfile.PlyData([plyfile.PlyElement.describe(points, "vertex")]).write(tmp_path / "a.ply")
    with caplog.at_level(logging.WARNING):
        assert read_model(tmp_path / "a.ply").count == 6
    assert "2 of 8 rows" in caplog.text
