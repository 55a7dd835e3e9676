"""Models of every format: what is written is read back, within the steps of the format."""

import json
import struct
import zipfile
import zlib

import numpy as np
import plyfile
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from clsplat.edit.transform import transformed
from clsplat.gaussians import Gaussians
from clsplat.georeference import Georeference
from clsplat.io.models.formats import SUFFIXES, count_of, read_model, write_model
from clsplat.io.models.gltf import write_spz_glb
from clsplat.io.models.values import half_turn
from tests.io.models.test_ply import UTM, random_gaussians
from tests.refusals import refused

POINTS = (".las", ".laz")
# largest errors of positions (share of the extent), log scales, rotations (radians), colours,
# opacities and harmonics; a further entry: positions have steps of 0.2 median standard deviations
BOUNDS = {
    ".ply": (0, 0, 0, 0, 0, 0),
    ".glb": (0, 1e-5, 1e-3, 1e-6, 1e-6, 0),
    ".sog": (1 / 20000, 0.05, 0.02, 0.05, 0.003, 0.05),
    ".spz": (0, 1 / 31, 0.01, 0.01, 0.003, 1 / 15, True),
}


def model(count=300, degree=3, offset=(0, 0, 0)):
    gaussians = random_gaussians(count, degree)
    rows = dict(gaussians.rows)
    rows["sh_rest"] = np.clip(0.2 * rows["sh_rest"], -0.9, 0.9)
    rows["sh_constant"] = np.clip(rows["sh_constant"], -1.7, 1.7)  # colours from 0 to 1
    return Gaussians(rows, degree, np.array(offset, np.float64))


def world(gaussians):
    return gaussians.positions.astype(np.float64) + gaussians.offset


def turns(a, b):
    """Angles between quaternions w, x, y, z; half turns about an ellipsoid's axes do not count."""
    a, b = (Rotation.from_quat(np.roll(q, -1, axis=1)) for q in (a, b))
    halves = [Rotation.identity(), *(Rotation.from_rotvec(np.pi * axis) for axis in np.eye(3))]
    return np.min([(a * half * b.inv()).magnitude() for half in halves], axis=0)


def opacity(gaussians):
    return 1 / (1 + np.exp(-gaussians.opacity_logits.astype(np.float64)))


def compare(found, expected, bounds):
    """Assert that two models are the same within bounds, whatever their order."""
    position, scale, rotation, colour, alpha, harmonic, *step = bounds
    assert found.count == expected.count
    if not expected.count:
        return
    away, match = cKDTree(world(found)).query(world(expected))
    assert len(set(match)) == expected.count
    extent = np.ptp(world(expected), axis=0).max() if expected.count > 1 else 1
    sigma = np.exp(np.median(expected.log_scales))
    assert away.max() <= position * extent + (0.18 * sigma if step else 1e-12)
    rows = {name: values[match] for name, values in found.rows.items()}
    assert np.abs(rows["log_scales"] - expected.log_scales).max() <= scale
    if rotation:
        assert turns(rows["quaternions"], expected.quaternions).max() <= rotation
    else:
        assert np.array_equal(rows["quaternions"], expected.quaternions)
    assert 0.2821 * np.abs(rows["sh_constant"] - expected.sh_constant).max() <= colour
    assert np.abs(opacity(found)[match] - opacity(expected)).max() <= alpha
    if harmonic is not None and expected.sh_degree:
        assert found.sh_degree == expected.sh_degree
        assert np.abs(rows["sh_rest"] - expected.sh_rest).max() <= harmonic


@pytest.mark.parametrize("suffix", BOUNDS)
@pytest.mark.parametrize("count, degree", [(0, 3), (1, 0), (1, 2), (300, 1), (300, 3)])
def test_round_trip(tmp_path, suffix, count, degree):
    path, gaussians = tmp_path / f"A{suffix.upper()}", model(count, degree)
    write_model(path, gaussians)
    compare(read_model(path), gaussians, BOUNDS[suffix])
    assert count_of(path) == count
    first = path.read_bytes()
    write_model(path, gaussians)
    assert path.read_bytes() == first
    assert [p.name for p in tmp_path.iterdir()] == [path.name]


@pytest.mark.parametrize("suffix", BOUNDS)
def test_large_coordinates(tmp_path, suffix):
    path, gaussians = tmp_path / f"a{suffix}", model(offset=UTM)
    write_model(path, gaussians)
    bounds = list(BOUNDS[suffix])
    bounds[0] += 1e-7
    compare(read_model(path), gaussians, bounds)
    moved = read_model(path, UTM + (100, 0, 0))
    assert np.array_equal(moved.offset, UTM + (100, 0, 0))
    bounds[0] += 1e-5
    compare(moved, gaussians, bounds)


@pytest.mark.parametrize("suffix", [".spz", ".sog"])
def test_unused_harmonics_are_not_written(tmp_path, suffix):
    gaussians = model(50, 3)
    gaussians.sh_rest[:, 3:] = 0
    write_model(tmp_path / f"a{suffix}", gaussians)
    if suffix != ".sog":
        assert read_model(tmp_path / f"a{suffix}").sh_degree == 1
    gaussians.sh_rest[:] = 0
    write_model(tmp_path / f"b{suffix}", gaussians)
    assert read_model(tmp_path / f"b{suffix}").sh_degree == 0


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_half_turn_is_that_rotation(axis):
    gaussians = model(20, 3)
    turned = half_turn({name: values.astype(np.float64) for name, values in gaussians.rows.items()}, axis)
    expected = transformed(gaussians, rotation=Rotation.from_rotvec(np.pi * np.eye(3)[axis]).as_matrix())
    assert turns(turned["quaternions"], expected.quaternions).max() < 1e-6
    for name in ("positions", "log_scales", "sh_constant", "sh_rest", "opacity_logits"):
        assert np.allclose(turned[name], expected.rows[name], atol=1e-6), name


def test_glb_is_upright_and_says_what_it_is(tmp_path):
    gaussians = model(5, 1)
    write_model(
        tmp_path / "a.glb",
        gaussians,
        ["SplatRenderMode: mip"],
        up=(0, 0, 1),
        georeference=Georeference("EPSG:32614", (5e5, 5e6, 0), "GPS", 0.1),
    )
    document, _ = parts(tmp_path / "a.glb")
    upright = Rotation.from_quat(document["nodes"][0]["rotation"])
    # half a turn about z keeps z; east becomes left, north becomes forward
    assert np.allclose(upright.apply([(0, 0, 1), (-1, 0, 0), (0, -1, 0)]), [(0, 1, 0), (-1, 0, 0), (0, 0, 1)])
    comments = document["asset"]["extras"]["comments"]
    assert "SplatRenderMode: mip" in comments and "up 0 0 1" in comments
    assert any(line.startswith("map_offset 500000.0 5000000.0 0.0") for line in comments)
    compare(read_model(tmp_path / "a.glb"), gaussians, BOUNDS[".glb"])


def test_an_antialiased_model_says_so(tmp_path):
    for comment, flag in (("SplatRenderMode: mip", 1), ("SplatRenderMode: default", 0)):
        write_model(tmp_path / "a.spz", model(3), [comment])
        assert zlib.decompress((tmp_path / "a.spz").read_bytes(), 31)[14] == flag
        write_model(tmp_path / "a.sog", model(3), [comment])
        with zipfile.ZipFile(tmp_path / "a.sog") as archive:
            assert json.loads(archive.read("meta.json"))["antialias"] == bool(flag)


def test_spz_of_version_2(tmp_path):
    """A file as the specification describes it, written here."""
    body = b"".join(
        (
            struct.pack("<4sIIBBBB", b"NGSP", 2, 1, 0, 8, 0, 0),
            b"".join(struct.pack("<i", v)[:3] for v in (256, -512, 768)),
            bytes([51]),
            bytes([127, 255, 0]),
            bytes([160, 176, 144]),
            bytes([255, 127, 127]),
        )
    )
    (tmp_path / "a.spz").write_bytes(
        b"\x1f\x8b\x08\0\0\0\0\0\0\xff" + packed(body, -15) + struct.pack("<II", zlib.crc32(body), len(body))
    )
    found = read_model(tmp_path / "a.spz")
    assert np.allclose(found.positions, [(1, 2, -3)])  # up is -y of a PLY, backward is -z
    assert np.allclose(opacity(found), 0.2) and np.allclose(found.log_scales, [(0, 1, -1)])
    assert np.allclose(found.sh_constant, [(-0.0130719, 10 / 3, -10 / 3)], atol=1e-5)
    assert turns(found.quaternions, np.array([[0, 1.0, 0, 0]]))[0] < 0.15


@pytest.mark.parametrize("suffix", [suffix for suffix in SUFFIXES if suffix not in POINTS])
def test_damage_is_one_line(tmp_path, suffix):
    path = tmp_path / f"a{suffix}"
    write_model(path, model(40, 1))
    data = path.read_bytes()
    for cut in (0, 7, len(data) // 2 + 1, len(data) - 1):
        path.write_bytes(data[:cut])
        refused(lambda: read_model(path), path.name)
    path.unlink()
    refused(lambda: read_model(path), "no such file")


def packed(body, bits):
    packer = zlib.compressobj(wbits=bits)
    return packer.compress(body) + packer.flush()


@pytest.mark.parametrize("suffix", POINTS)
def test_points_in_map_coordinates(tmp_path, suffix):
    laspy = pytest.importorskip("laspy", reason="laspy is an extra: pip install 'clsplat[geo]'")
    place = Georeference("EPSG:32614", (5e5, 4e6, 100.0), "GPS", 0.1)
    path, gaussians = tmp_path / f"a{suffix}", model(200, offset=(10, 20, 30))
    write_model(path, gaussians, georeference=place)
    las = laspy.read(path)
    assert las.header.are_points_compressed == (suffix == ".laz")
    assert las.header.parse_crs().to_epsg() == 32614
    assert np.abs(np.asarray(las.xyz) - world(gaussians) - place.offset).max() < 0.01
    assert np.allclose(las.intensity / 65535, opacity(gaussians), atol=1e-5)
    found = read_model(path, georeference=place)
    assert np.abs(world(found) - world(gaussians)).max() < 0.01
    assert 0.2821 * np.abs(found.sh_constant - gaussians.sh_constant).max() < 0.003
    local = read_model(path, gaussians.offset, place)
    assert np.array_equal(local.offset, gaussians.offset)
    assert np.abs(local.positions - gaussians.positions).max() < 0.01
    assert np.abs(world(read_model(path)) - world(gaussians) - place.offset).max() < 0.01
    data = path.read_bytes()
    for cut in (0, 100, 300, len(data) - 20):
        path.write_bytes(data[:cut])
        refused(lambda: read_model(path), "not a LAS or LAZ file")


@pytest.mark.parametrize("kind, scale", [("u1", 1), ("u2", 257), ("f4", 1 / 255)])
def test_clouds(tmp_path, kind, scale):
    points = np.random.default_rng(0).normal(size=(60, 3)) + UTM
    colours = np.random.default_rng(1).integers(0, 256, (60, 3))
    table = np.zeros(60, [*((name, "f8") for name in "xyz"), *((name, kind) for name in ("red", "green", "blue"))])
    for name, values in zip(table.dtype.names, [*points.T, *(scale * colours).T]):
        table[name] = values
    path = tmp_path / "a.ply"
    plyfile.PlyData([plyfile.PlyElement.describe(table, "vertex")]).write(path)
    found = read_model(path)
    assert np.abs(world(found) - points).max() < 1e-5 and found.sh_degree == 0
    assert np.abs(255 * (0.5 + 0.28209479 * found.sh_constant) - colours).max() < 0.01
    assert np.array_equal(read_model(path, UTM).offset, UTM)
    same = np.repeat(table[:1], 60)
    plyfile.PlyData([plyfile.PlyElement.describe(same, "vertex")]).write(path)
    refused(lambda: read_model(path), "fewer than two places")


def parts(path):
    """The document of a binary glTF and its buffer."""
    data = path.read_bytes()
    (size,) = struct.unpack_from("<I", data, 12)
    return json.loads(data[20 : 20 + size]), data[28 + size :]


def changed(path, document, content):
    text = json.dumps(document).encode()
    path.write_bytes(
        struct.pack("<4sII", b"glTF", 2, 0)
        + struct.pack("<I4s", len(text), b"JSON")
        + text
        + struct.pack("<I4s", len(content), b"BIN\0")
        + content
    )


@pytest.mark.parametrize("count, degree", [(1, 0), (200, 0), (200, 3)])
def test_glb_of_spz_as_3d_tiles_have_it(tmp_path, count, degree):
    path, gaussians = tmp_path / "a.glb", model(count, degree)
    write_spz_glb(path, gaussians)
    compare(read_model(path), gaussians, BOUNDS[".spz"])
    moved = read_model(path, (1.0, 2.0, 3.0))
    assert np.array_equal(moved.offset, (1, 2, 3))
    compare(moved, gaussians, BOUNDS[".spz"])


def test_another_place_of_the_buffer_and_damage(tmp_path):
    path, gaussians = tmp_path / "a.glb", model(40, 1)
    write_spz_glb(path, gaussians)
    document, content = parts(path)
    view = document["bufferViews"][0]
    changed(path, {**document, "bufferViews": [{**view, "byteOffset": 8}]}, bytes(8) + content)
    compare(read_model(path), gaussians, BOUNDS[".spz"])
    for change in ({"byteOffset": 8}, {"byteOffset": -1}, {"byteLength": 30}, {"buffer": 1}):
        changed(path, {**document, "bufferViews": [{**view, **change}]}, content)
        refused(lambda: read_model(path), "a.glb: not a binary glTF")
    turned = {**document["nodes"][0], "name": "of another program"}
    changed(path, {**document, "nodes": [turned]}, content)
    refused(lambda: read_model(path), "a node turns, scales or moves others")
