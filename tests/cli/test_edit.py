"""`clsplat edit` and `clsplat export` to a folder, from the command line; no device is needed."""

import json

import numpy as np
import pyproj
import pytest

from clsplat.edit.select import selected
from clsplat.georeference import Georeference
from clsplat.io.georeference.files import write_georeference, write_orientation
from clsplat.io.models.formats import read_model, write_model
from clsplat.io.runs.run import RunFolder
from tests.command_line import clsplat_
from tests.data.cloud import cloud

PLACE = Georeference("EPSG:32633", (465_000.0, 5_800_000.0, 50.0), "GPS", 1.0)


@pytest.fixture
def model(tmp_path):
    """The model in model.ply, with a known place and a known direction up."""
    model = cloud(80, offset=(100.0, 200.0, 10.0))
    write_model(tmp_path / "model.ply", model, up=(0.0, 0.0, 1.0), georeference=PLACE)
    return model


def edited(tmp_path, *arguments):
    """(the result of an edit of model.ply, what the command printed)."""
    result = clsplat_("edit", tmp_path / "model.ply", "-o", tmp_path / "out.ply", "--overwrite", *arguments)
    assert result.exit_code == 0, result.output
    return read_model(tmp_path / "out.ply"), result.output


def same(found, expected):
    assert found.count == expected.count
    assert np.allclose(found.positions + found.offset, expected.positions + expected.offset, atol=1e-4)


def test_crop(tmp_path, model):
    x, y, _ = (model.positions + model.offset).T
    corner = "100 200 -inf inf inf inf".split()
    quarter = selected(model, (x >= 100) & (y >= 200))
    assert 5 < quarter.count < 40
    same(edited(tmp_path, "--box", *corner)[0], quarter)
    same(edited(tmp_path, "--box", *corner, "--outside")[0], selected(model, ~((x >= 100) & (y >= 200))))
    found, output = edited(tmp_path, "--polygon", "100,200 900,200 900,900 100,900")
    same(found, quarter)
    assert f"{80 - quarter.count} of 80 gaussians are outside" in output


def test_geojson_in_every_crs(tmp_path, model):
    x, y, _ = (model.positions + model.offset).T
    ring = np.array([[100.0, 200], [900, 200], [900, 900], [100, 900]]) + PLACE.offset[:2]
    to_degrees = pyproj.Transformer.from_crs("EPSG:32633", "OGC:CRS84", always_xy=True)
    degrees = np.stack(to_degrees.transform(*ring.T), axis=1)
    path = tmp_path / "area.geojson"
    for corners, crs in ((degrees, None), (ring, "EPSG:32633"), (ring, "urn:ogc:def:crs:EPSG::32633")):
        path.write_text(
            json.dumps(
                {
                    "type": "Polygon",
                    "coordinates": [corners.tolist()],
                    **({"crs": {"type": "name", "properties": {"name": crs}}} if crs else {}),
                }
            )
        )
        same(edited(tmp_path, "--polygon", path)[0], selected(model, (x >= 100) & (y >= 200)))


def test_several_polygons_and_holes(tmp_path):
    model = cloud(80)
    write_model(tmp_path / "model.ply", model)
    x, y, _ = model.positions.T
    path = tmp_path / "area.geojson"
    hole = [[[-9, -9], [9, -9], [9, 9], [-9, 9]], [[0, 0], [0, 9], [9, 9], [9, 0], [0, 0]]]
    path.write_text(
        json.dumps({"type": "MultiPolygon", "coordinates": [hole, [[[0.2, 0.2], [0.2, 9], [9, 9], [9, 0.2]]]]})
    )
    same(edited(tmp_path, "--polygon", path)[0], selected(model, (x < 0) | (y < 0) | (x > 0.2) & (y > 0.2)))
    path.write_text(
        json.dumps(
            {"type": "Polygon", "coordinates": hole, "crs": {"type": "name", "properties": {"name": "EPSG:32633"}}}
        )
    )
    result = clsplat_("edit", tmp_path / "model.ply", "-o", tmp_path / "x.ply", "--polygon", path)
    assert result.exit_code == 2 and "has no georeference" in result.output


def test_polygons_lie_on_the_ground_of_a_scene_that_is_not_upright(tmp_path):
    model = cloud(80)
    write_model(tmp_path / "model.ply", model, up=(0.0, -1.0, 0.0))
    found, _ = edited(tmp_path, "--polygon", "0,-9 9,-9 9,9 0,9")
    same(found, selected(model, model.positions[:, 0] >= 0))
    found, _ = edited(tmp_path, "--polygon", "-9,0 9,0 9,9 -9,9")
    same(found, selected(model, model.positions[:, 2] >= 0))


def test_cleaning_and_fewer(tmp_path, model):
    opacity = 1 / (1 + np.exp(-model.opacity_logits))
    found, output = edited(tmp_path, "--min-opacity", 0.3, "--max-size", 0.2)
    keep = (opacity >= 0.3) & (np.exp(model.log_scales).max(axis=1) <= 0.2)
    same(found, selected(model, keep))
    assert "are less opaque than 0.3" in output and "are larger than 0.2" in output
    assert edited(tmp_path, "--decimate", 0.25)[0].count == 20
    assert edited(tmp_path, "--decimate", 30)[0].count == 30


@pytest.mark.parametrize("suffix", [".ply", ".glb", ".spz", ".sog"])
def test_what_a_file_says_of_its_training_goes_on(tmp_path, model, suffix):
    path = tmp_path / f"mip{suffix}"
    write_model(path, model, ("SplatRenderMode: mip",), (0.0, 0.0, 1.0), PLACE)
    result = clsplat_("edit", path, "-o", tmp_path / "out.ply")
    assert result.exit_code == 0, result.output
    header = (tmp_path / "out.ply").read_bytes()[:2000]
    assert b"comment SplatRenderMode: mip" in header
    has_place = suffix in (".ply", ".glb")
    assert (b"EPSG:32633" in header) == has_place == (b"Vertical Axis: z" in header)


def test_transform_and_place(tmp_path, model):
    found, output = edited(tmp_path, "--scale", 2, "--rotate", 0, 0, 90, "--translate", 1, -2, 3)
    x, y, z = (model.positions + model.offset).T
    assert np.allclose(found.positions + found.offset, np.stack([-2 * y + 1, 2 * x - 2, 2 * z + 3], axis=1), atol=1e-4)
    turned, _ = edited(tmp_path, "--rotate", 90, 0, 90)  # about x first
    assert np.allclose(turned.positions + turned.offset, np.stack([z, x, y], axis=1), atol=1e-4)
    header = (tmp_path / "out.ply").read_bytes()[:2000]
    assert b"the georeference is left out" in output.encode() and b"EPSG" not in header
    edited(tmp_path, "--translate", 1, 2, 3)
    header = (tmp_path / "out.ply").read_bytes()[:2000]
    assert b"EPSG:32633" in header and b"Vertical Axis: z" in header


def test_models_are_merged_on_the_map(tmp_path, model):
    other = cloud(30, seed=3, offset=(90.0, 210.0, 10.0))
    write_model(
        tmp_path / "other.ply",
        other,
        up=(0.0, 0.0, 1.0),
        georeference=Georeference("EPSG:32633", (465_010.0, 5_799_990.0, 50.0), "", 0.0),
    )
    found, _ = edited(tmp_path, tmp_path / "other.ply")
    whole = np.concatenate([model.positions + model.offset, other.positions + other.offset + [10, -10, 0]])
    assert np.allclose(found.positions + found.offset, whole, atol=1e-4)
    write_model(
        tmp_path / "other.ply",
        other,
        up=(0.0, 0.0, 1.0),
        georeference=Georeference("EPSG:32634", PLACE.offset, "", 0.0),
    )
    result = clsplat_("edit", tmp_path / "model.ply", tmp_path / "other.ply", "-o", tmp_path / "both.ply")
    assert result.exit_code == 2 and "has the CRS EPSG:32634" in result.output
    write_model(tmp_path / "mip.ply", other, ("SplatRenderMode: mip",))
    result = clsplat_("edit", tmp_path / "model.ply", tmp_path / "mip.ply", "-o", tmp_path / "both.ply")
    assert result.exit_code == 2 and "trained with --antialiased" in result.output


def test_it_keeps_what_was_there(tmp_path, model):
    path, out = tmp_path / "model.ply", tmp_path / "out.ply"
    before = path.read_bytes()
    for arguments, complaint in (
        ((path, "-o", path, "--overwrite"), "is one of the models"),
        ((path, "-o", out, "--box", *"5 5 5 6 6 6".split()), "none of its 80 gaussians"),
        ((path, "-o", out, "--box", *"5 5 5 4 6 6".split()), "--box: is empty"),
        ((path, "-o", out, "--polygon", "0,0 1,1"), "at least three corners"),
        ((path, "-o", out, "--polygon", "missing.geojson"), "no such file"),
        ((path, "-o", out, "--decimate", "1.5"), "neither a share"),
        ((path, "-o", out, "--scale", "nan"), "not a finite number"),
        ((path, "-o", out, "--outside"), "has no effect without"),
        ((path, "-o", out, "--min-support", "2"), "name them with --scene"),
        ((path, "-o", tmp_path / "out.xyz"), "unknown suffix"),
        ((tmp_path / "missing.ply", "-o", out), "no such file"),
    ):
        result = clsplat_("edit", *arguments)
        assert result.exit_code == 2 and complaint in result.output, result.output
    assert path.read_bytes() == before and not out.exists()
    out.write_text("mine")
    result = clsplat_("edit", path, "-o", out)
    assert result.exit_code == 2 and "exists already" in result.output
    assert out.read_text() == "mine"


def test_a_run_becomes_tiles(tmp_path):
    run, model = tmp_path / "run", cloud(60)
    model.rows["opacity_logits"][7] = -30
    folder = RunFolder.create(run)
    folder.write_options({"downscale": 1.0})
    folder.save_model(model, (0, 0, 0))
    write_orientation(run, (0.0, 0.0, 1.0))
    result = clsplat_("export", run, "-o", tmp_path / "tiles")
    assert result.exit_code == 0 and "59 gaussians" in result.output, result.output
    assert result.output.endswith("left out as invisible: 1\n")
    root = json.loads((tmp_path / "tiles" / "tileset.json").read_text())["root"]
    assert root["transform"][12:] == [0, 0, 0, 1]
    result = clsplat_("export", run, "-o", tmp_path / "tiles")
    assert result.exit_code == 2 and "exists already" in result.output
    write_georeference(run, PLACE)
    result = clsplat_("edit", run, "-o", tmp_path / "run.ply")
    assert result.exit_code == 0, result.output
    assert b"EPSG:32633" in (tmp_path / "run.ply").read_bytes()[:2000]
