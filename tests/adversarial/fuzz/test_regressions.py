"""The worst that fuzzing found, each made by hand: what it did once is said beside it."""

import contextlib
import io
import json
import struct
import tracemalloc
import zipfile

import numpy as np
import pytest

from clsplat.cli.train import resumed_options
from clsplat.errors import InputError
from clsplat.io.models.formats import read_model, write_model
from clsplat.io.models.ply import read_ply
from clsplat.io.photos.images import read_image, write_image
from clsplat.io.runs.run import RunFolder
from clsplat.io.scenes.packed import write_packed
from clsplat.io.scenes.read import read_scene
from clsplat.options import from_toml
from clsplat.synth import geometry
from clsplat.synth.layout import city
from tests.adversarial.fuzz.reader import gaussians_like
from tests.adversarial.fuzz.readers import READERS
from tests.data.tiny_model import write_scene

MOST_BYTES = 8 << 20  # that a refusal may allocate


def refused(read, path, *words):
    """The one line with which a file is refused, little allocated; it holds the words."""
    tracemalloc.start()
    try:
        with pytest.raises(InputError) as caught:
            read(path)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    message = str(caught.value)
    assert peak < MOST_BYTES and len(message.splitlines()) == 1 and len(message) < 1000
    for word in (path.name, *words):
        assert word in message, message


@pytest.fixture(scope="module")
def packed(tmp_path_factory):
    """The arrays of a packed scene; not to be changed."""
    folder = tmp_path_factory.mktemp("packed")
    write_packed(read_scene(write_scene(folder / "town")), folder / "town.npz")
    with np.load(folder / "town.npz") as file:
        return dict(file)


def members(arrays):
    found = {}
    for name, array in arrays.items():
        np.save(out := io.BytesIO(), array)
        found[f"{name}.npy"] = out.getvalue()
    return found


def write_members(path, found, **how):
    with zipfile.ZipFile(path, "w", **how) as archive:
        for name, content in found.items():
            archive.writestr(name, content)
    return path


@pytest.mark.parametrize("old, new, did", [
    (b"(30, 3)", b"(30, 3 ", "tokenize.TokenError, out of numpy's parser of headers"),
    (b"(30, 3), }" + b" " * 11, b"(1000000000000, 3), }", "allocated 24 TB"),
    (b"(30, 3)", b"(10, 3)", "what was left over was not missed"),
    (b"'<f8'", b"'|O' ", "refused before, too: no pickle is read"),
    (b"\x93NUMPY", b"NUMPY\x93", "AttributeError: numpy gives bytes for what is no array"),
])
def test_an_array_with_a_wrong_header(tmp_path, packed, old, new, did):
    found = members(packed)
    assert old in found["xyz.npy"] and len(old) == len(new)
    found["xyz.npy"] = found["xyz.npy"].replace(old, new)
    refused(read_scene, write_members(tmp_path / "town.npz", found), "pack or copy it again")


def test_a_zip_bomb(tmp_path, packed):
    """A hundred kilobytes became a hundred megabytes, and could have become as many as one likes.
    """
    found = members({**packed, "xyz": np.zeros((4 << 20, 3))})
    path = write_members(tmp_path / "town.npz", found, compression=zipfile.ZIP_DEFLATED)
    refused(read_scene, path, "claim to hold")


def test_a_zip_that_claims_gigabytes(tmp_path, packed):
    """Python allocated what zipfile asked for: the compressed size, by the file's own words."""
    path = write_members(tmp_path / "town.npz", members(packed))
    data = bytearray(path.read_bytes())
    struct.pack_into("<L", data, data.rindex(b"PK\1\2") + 20, 2**31 - 1)
    path.write_bytes(data)
    tracemalloc.start()
    try:
        read_scene(path)  # what matters is whole
    except InputError as error:  # later Pythons see themselves that members overlap
        assert "zip bomb" in str(error)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < MOST_BYTES


def test_a_sog_that_claims_gigabytes(tmp_path):
    """As `test_a_zip_that_claims_gigabytes`: it is a zip, too."""
    path = tmp_path / "model.sog"
    write_model(path, gaussians_like(6, 0))
    data = bytearray(path.read_bytes())
    struct.pack_into("<L", data, data.index(b"PK\1\2") + 20, 2**31 - 1)
    path.write_bytes(data)
    tracemalloc.start()
    with contextlib.suppress(InputError):  # what matters is whole
        read_model(path)
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < MOST_BYTES


@pytest.mark.parametrize("name, did", [
    (np.array([0x110000], np.uint32).view("<U1")[0:1], "SystemError: no such character"),
    ("a\nb.png", "a message of two lines"),
    ("a" * 300 + ".png", "OSError: file name too long, of a folder with such a photo's name"),
])
def test_names_that_are_none(tmp_path, packed, name, did):
    names = packed["names"].astype("<U304")
    if isinstance(name, str):
        names[1] = name
    else:
        names.view("<u4").reshape(len(names), -1)[1, 0] = 0x110000
    np.savez(tmp_path / "town.npz", **{**packed, "names": names})
    refused(read_scene, tmp_path / "town.npz", "name")


def test_poses_that_are_no_poses(tmp_path, packed):
    """1e300 is finite, but no square of it: NaN came of it later. float16 overflowed at once."""
    poses = packed["V"].copy()
    poses[1, 0, 3] = 1e300
    np.savez(tmp_path / "town.npz", **{**packed, "V": poses})
    refused(read_scene, tmp_path / "town.npz", "photo_1.png is not below")
    np.savez(tmp_path / "half.npz", **{**packed, "V": packed["V"].astype(np.float16) * 2})
    refused(read_scene, tmp_path / "half.npz", "photo_0.png is not a rotation")


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian"])
def test_a_ply_that_claims_more_than_it_has(tmp_path, form):
    """plyfile allocated all rows before it looked for the first."""
    (tmp_path / "a.ply").write_text(
        f"ply\nformat {form} 1.0\nelement vertex 1000000000000\nproperty float x\n"
        "property list uchar float y\nend_header\n1 0\n")
    refused(read_ply, tmp_path / "a.ply", "too few for the rows")


def test_a_ply_of_text_beyond_float(tmp_path, recwarn):
    """numpy warned of the overflow before the line that refuses it."""
    (tmp_path / "a.ply").write_text(
        "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\n"
        "property float z\nend_header\n1e300 0 0\n")
    refused(read_ply, tmp_path / "a.ply")
    assert not recwarn.list


@pytest.mark.parametrize("side, words", [(60000, ()), (4000, ("4000x4000",))])
def test_an_image_that_claims_more_than_it_has(tmp_path, side, words):
    """Its pixels were allocated before the first was decoded; OpenImageIO sees the worst itself."""
    write_image(tmp_path / "a.jpg", np.zeros((8, 8, 3), np.uint8))
    data = bytearray((tmp_path / "a.jpg").read_bytes())
    struct.pack_into(">HH", data, data.index(b"\xff\xc0") + 5, side, side)
    (tmp_path / "a.jpg").write_bytes(data)
    refused(read_image, tmp_path / "a.jpg", "copy it again", *words)


def run_with(folder, options=None, line=None):
    """A run folder whose options.json, or whose metrics, end with a given text."""
    run = RunFolder.create(folder)
    run.write_options({"scene": "town", "sh_degree": 0})
    run.log({"event": "step", "iteration": 1, "train_seconds": 0.5})
    if options:
        path = folder / "options.json"
        path.write_text(path.read_text().rstrip("}\n") + f", {options}}}\n")
    if line:
        with open(folder / "metrics.jsonl", "a") as file:
            file.write(line + "\n")
    return run


@pytest.mark.parametrize("line, did", [
    ("[" * 3000, "RecursionError"),
    ('{"event": "eval", "psnr_cc": NaN}', "ValueError when compare.json was written"),
    ('{"event": "eval", "psnr_cc": 1e400}', "the same, though it is no NaN in the file"),
    ('{"event": "eval", "ssim": "high"}', "TypeError in a mean"),
    ('{"event": "step", "iteration": "many"}', "TypeError in a comparison"),
    ('{"event": "step", "frequency": 3}', "TypeError: 'int' object is not a mapping"),
    ('{"event": "plan", "reasons": ["none"]}', "AttributeError: a list has no items()"),
    ('{"event": "level", "reason": "\\ud800"}', "UnicodeEncodeError in the page"),
])
def test_metrics_that_cannot_be_computed_with(tmp_path, line, did):
    run = run_with(tmp_path, line=line)
    refused(lambda path: run.records(), tmp_path / "metrics.jsonl", "line 2 is damaged")


@pytest.mark.parametrize("text, did", [
    ('"seed": "0"', "TypeError when runs were sorted by it"),
    ('"fingerprint": 5', "TypeError: an int has no beginning"),
    ('"scene": []', "TypeError: no path"),
])
def test_options_of_a_run_of_the_wrong_type(tmp_path, text, did):
    run = run_with(tmp_path, options=text)
    refused(lambda path: run.read_options(), tmp_path / "options.json", "damaged")


def test_an_option_of_a_run_is_blamed_on_its_file(tmp_path):
    """The message said "command line", where nobody had given any."""
    run = run_with(tmp_path, options='"rounds": 0.5')
    refused(lambda path: resumed_options(run.read_options(), {}), tmp_path / "options.json",
            "rounds")


@pytest.mark.parametrize("text, did", [
    ("seed = " + "9" * 5000, "ValueError: exceeds the limit for integer string conversion"),
    ("seed = " + "9" * 400, "accepted; OverflowError later"),
    ("downscale = " + "9" * 400, "OverflowError: int too large to convert to float"),
    ("levels = " + "[" * 3000, "RecursionError"),
    ("a" * 5000 + " = 3", "a message of 5000 characters"),
])
def test_toml_beyond_limits(tmp_path, text, did):
    (tmp_path / "run.toml").write_text(text)
    refused(from_toml, tmp_path / "run.toml")


@pytest.mark.parametrize("change, did", [
    ({"blocks": [None, 2]}, "TypeError when the extent was asked for"),
    ({"spheres": [{"centre": [0, 0, 1], "radius": float("nan")}]}, "every distance was NaN"),
    ({"parks": [[0]]}, "a shape that fits nothing"),
    ({"about": ["x" * 9000], "boxes": "\udcff"}, "a message with the whole file in it"),
])
def test_a_geometry_of_no_city(tmp_path, change, did):
    path = tmp_path / "geometry.json"
    geometry.save(city((2, 1)), path)
    path.write_text(json.dumps({**json.loads(path.read_text()), **change}))
    refused(geometry.load, path, "make the scene again")


@pytest.mark.parametrize("name, change, did", [
    ("row.positions", lambda array: array[:-1], "rows of different numbers: IndexError later"),
    ("row.log_scales", lambda array: array * np.float32(np.nan), "trained on, to NaN"),
    ("m.positions", lambda array: array.astype("S3"), "ValueError deep in a kernel's arguments"),
])
def test_a_checkpoint_that_does_not_fit_itself(tmp_path, name, change, did):
    reader = READERS["checkpoint"]
    for path, content in reader.seeds()[0].items():
        (tmp_path / path).write_bytes(content)
    run = RunFolder.open(tmp_path)
    arrays, state = run.load_checkpoint()
    reader.read(tmp_path)
    run.save_checkpoint({**arrays, name: change(arrays[name])}, state)
    with pytest.raises(InputError, match=name):
        reader.read(tmp_path)
