import json

import numpy as np
import pyproj
import pytest
from scipy.spatial import cKDTree

from clsplat.apps import tiles as tiles_module
from clsplat.apps.models import turned_up
from clsplat.apps.tiles import Z_UP, placement, write_tiles
from clsplat.edit.decimate import decimated
from clsplat.edit.select import merged
from clsplat.georeference import Georeference
from clsplat.io.models.formats import read_with_notes
from tests.data.cloud import cloud
from tests.io.models.test_formats import BOUNDS, compare, model, parts

Y_TO_Z = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # what a viewer does to glTF content
SPZ_TO_PLY = np.diag([1.0, -1, -1])  # what `read_with_notes` does to the axes of SPZ


def content_of(path):
    """The gaussians of a tile, and the matrix [3, 3] from there to what a viewer has."""
    document, _ = parts(path)
    model, notes = read_with_notes(path)
    node = document["nodes"][0]  # whose turn is not read
    assert notes.antialiased
    accessors = document["accessors"]
    assert {accessor["count"] for accessor in accessors} == {model.count}
    assert len(accessors) == 4 + (model.sh_degree + 1) ** 2 - 1
    return model, Y_TO_Z @ np.reshape(node["matrix"], (4, 4)).T[:3, :3] @ SPZ_TO_PLY


def written(tmp_path, model, limit, georeference=None):
    """(the tileset, its tiles in order, each with its places [N, 3] as a viewer has them)."""
    count = write_tiles(tmp_path, model, georeference, ("SplatRenderMode: mip",), limit)
    tileset = json.loads((tmp_path / "tileset.json").read_text())
    transform = np.reshape(tileset["root"]["transform"], (4, 4)).T
    tiles = []

    def visit(record):
        model, turn = content_of(tmp_path / record["content"]["uri"])
        local = model.positions.astype(float) @ turn.T
        tiles.append((record, model, local, local @ transform[:3, :3].T + transform[:3, 3]))
        for child in record.get("children", ()):
            visit(child)

    visit(tileset["root"])
    assert count == len(tiles)
    return tileset, tiles


def test_the_leaves_hold_every_gaussian_once(tmp_path, monkeypatch):
    made = []
    monkeypatch.setattr(
        tiles_module, "decimated", lambda whole, count: (made.append(whole.count), decimated(whole, count))[1]
    )
    model = cloud(1000, sh_degree=1, size=0.02, offset=(7.0, -3.0, 100.0))
    _, tiles = written(tmp_path, model, 60)
    leaves = [tile for tile in tiles if "children" not in tile[0]]
    inner = [tile for tile in tiles if "children" in tile[0]]
    assert len(inner) > 5 and max(tile[1].count for tile in tiles) <= 60
    assert len(made) == len(inner) and max(made) <= 8 * 60, "of the tiles below, not of all rows"
    assert min(tile[1].count for tile in leaves) >= 30, "no tiles of a few outliers"
    whole = model.positions + model.offset
    places = np.concatenate([places for *_, places in leaves])
    away, nearest = cKDTree(places).query(whole)
    assert len(places) == len(whole) == len(set(nearest)) and away.max() < 5e-3
    colours = np.concatenate([tile[1].sh_constant for tile in leaves])[nearest]
    shown = np.abs(model.sh_constant) < 1.7  # SPZ holds no brighter or darker ones
    assert np.abs(colours - model.sh_constant)[shown].max() < 0.02


def ends_of(record):
    """The two corners of a tile's box, which has the directions of the axes."""
    box = np.array(record["boundingVolume"]["box"])
    return box[:3] - np.diag(box[3:].reshape(3, 3)), box[:3] + np.diag(box[3:].reshape(3, 3))


def test_the_tileset_keeps_the_rules_of_3d_tiles(tmp_path):
    """Those of the JSON schema of OGC 22-025r4 (3D Tiles 1.1), and of its sections on tiles."""
    tileset, tiles = written(tmp_path, cloud(500, sh_degree=1, size=0.05), 40)
    assert set(tileset) == {"asset", "extensionsUsed", "extensions", "geometricError", "root"}
    assert tileset["asset"]["version"] == "1.1"
    assert set(tileset["extensions"]) <= set(tileset["extensionsUsed"])
    transform = np.reshape(tileset["root"]["transform"], (4, 4)).T
    assert transform[3].tolist() == [0, 0, 0, 1] and np.linalg.det(transform) > 0
    assert tileset["root"]["refine"] in ("ADD", "REPLACE"), "the root must say it"
    local = {record["content"]["uri"]: (model, places) for record, model, places, _ in tiles}
    assert tileset["geometricError"] >= tileset["root"]["geometricError"]
    for record, *_ in tiles:
        assert (
            {"boundingVolume", "geometricError", "content"}
            <= set(record)
            <= {"boundingVolume", "geometricError", "content", "children", "refine", "transform"}
        )
        assert list(record["boundingVolume"]) == ["box"] and record["geometricError"] >= 0
        numbers = record["boundingVolume"]["box"]
        assert len(numbers) == 12 and np.isfinite(numbers).all()
        low, high = ends_of(record)
        assert (low < high).all()
        path = tmp_path / record["content"]["uri"]
        assert path.is_file() and path.resolve().is_relative_to(tmp_path.resolve())
        assert record.get("children") != []
        assert (record["geometricError"] > 0) == ("children" in record)
        for child in record.get("children", ()):
            assert child["geometricError"] < record["geometricError"]
            assert "refine" not in child or child["refine"] in ("ADD", "REPLACE")
            least, most = ends_of(child)  # rounded, as centre and half
            assert (least >= low - 1e-9).all() and (most <= high + 1e-9).all()
        model, places = local[record["content"]["uri"]]
        reach = np.exp(model.log_scales).max(axis=1)[:, None]  # the largest standard deviation
        assert (places - reach >= low - 0.1).all() and (places + reach <= high + 0.1).all()
    assert set(local) == {f"tiles/{path.name}" for path in (tmp_path / "tiles").iterdir()}


def test_a_viewer_has_the_model_that_was_written(tmp_path):
    """Positions, sizes, turns, colours and harmonics, of a model that must be turned upright."""
    up, written_model = np.array([0.0, -0.6, -0.8]), model(300, 2, (3.0, -50.0, 7.0))
    expected = turned_up(written_model, up, Z_UP)
    tileset, tiles = written(tmp_path, expected, 90)
    transform = np.reshape(tileset["root"]["transform"], (4, 4)).T
    leaves = []
    for record, found, *_ in tiles:
        turn = content_of(tmp_path / record["content"]["uri"])[1]
        assert np.allclose(transform[:3, :3] @ turn, np.eye(3))
        if "children" not in record:
            leaves.append(found.located(transform[:3, 3]))
    compare(merged(leaves), expected, BOUNDS[".spz"])


def test_on_the_earth(tmp_path):
    place = Georeference("EPSG:32633", (465_000.0, 5_800_000.0, 50.0), "", 0.0)
    model = cloud(50, offset=(100.0, 200.0, 10.0))
    _, tiles = written(tmp_path, model, 60, place)
    # heights are above the ellipsoid
    east, north, height = (model.positions + model.offset + np.array(place.offset)).T
    degrees = pyproj.Transformer.from_crs("EPSG:32633", "OGC:CRS84", always_xy=True).transform(east, north)
    expected = np.stack(
        pyproj.Transformer.from_crs("EPSG:4979", "EPSG:4978", always_xy=True).transform(*degrees, height), axis=1
    )
    assert cKDTree(tiles[0][3]).query(expected)[0].max() < 0.03
    matrix = placement(model.offset, place)
    assert np.linalg.det(matrix[:3, :3]) == pytest.approx(1, abs=2e-3), "no mirror"
