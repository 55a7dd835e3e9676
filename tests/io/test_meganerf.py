"""Mega-NeRF's folders: a scene written so is read back equal, and no pickle in it is ever run."""

import base64
import io
import pickle
import shutil
import struct
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest

from clsplat.errors import InputError
from clsplat.io.scenes import read_scene
from clsplat.io.torch_archive import read_torch
from tests.data.layouts import (
    assert_same_cameras,
    every_fourth,
    torch_file,
    world_points,
    write_meganerf,
    write_model,
)

CITY = Path(__file__).resolve().parents[2] / "data_samples/city"
HELD_OUT = {"004.jpg", "024.jpg"}  # the second and the seventh
# data.pkl of torch 2.13's torch.save({"H": 3456, "W": 4608, "c2w": float32[3, 4],
# "intrinsics": float32[4], "distortion": float32[4]})
WRITTEN_BY_TORCH = base64.b64decode(
    "gAJ9cQAoWAEAAABIcQFNgA1YAQAAAFdxAk0AElgDAAAAYzJ3cQNjdG9yY2guX3V0aWxzCl9yZWJ1aWxkX3RlbnNvcl"
    "92MgpxBCgoWAcAAABzdG9yYWdlcQVjdG9yY2gKRmxvYXRTdG9yYWdlCnEGWAEAAAAwcQdYAwAAAGNwdXEISwx0cQlR"
    "SwBLA0sEhnEKSwRLAYZxC4ljY29sbGVjdGlvbnMKT3JkZXJlZERpY3QKcQwpUnENdHEOUnEPWAoAAABpbnRyaW5zaW"
    "NzcRBoBCgoaAVoBlgBAAAAMXERaAhLBHRxElFLAEsEhXETSwGFcRSJaAwpUnEVdHEWUnEXWAoAAABkaXN0b3J0aW9u"
    "cRhoBCgoaAVoBlgBAAAAMnEZaAhLBHRxGlFLAEsEhXEbSwGFcRyJaAwpUnEddHEeUnEfdS4=")


@pytest.fixture(scope="module")
def city():
    return every_fourth(read_scene(CITY))


@pytest.fixture(scope="module")
def written(tmp_path_factory, city):
    """A folder, not to be changed."""
    folder = tmp_path_factory.mktemp("large") / "rubble"
    write_meganerf(folder, city, HELD_OUT)
    return folder


@pytest.fixture
def folder(tmp_path, written):
    return Path(shutil.copytree(written, tmp_path / "rubble"))


def name(old):
    """Photos are numbered in their order; every fourth of the city's is there."""
    part = "val" if old in HELD_OUT else "train"
    return f"{part}/{int(old[:3]) // 4:06d}.jpg"


def test_cameras_and_held_out_views(written, city):
    scene = read_scene(written)
    assert_same_cameras(scene, city, name)
    assert scene.held_out == {name(old) for old in HELD_OUT}
    assert {view.name for view in scene.split(8)[1]} == scene.held_out
    assert scene.path == written and scene.name == "rubble" and len(scene.points) == 4000
    assert scene.views[0].source == written / "train/rgbs/000000.jpg"


def test_numbers_of_single_precision(tmp_path, city):
    write_meganerf(tmp_path, city, HELD_OUT, dtype=np.float32)
    scene = read_scene(tmp_path)
    assert_same_cameras(scene, city, name, tolerance=1e-6)
    for view in scene.views:
        rotation = view.camera.rotation
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-14)


def test_points_of_the_colmap_model_the_poses_came_from(folder, city):
    write_model(folder / "sparse/0", city, city.views, np.arange(300))
    scene = read_scene(folder)
    np.testing.assert_allclose(world_points(scene), world_points(city)[:300], atol=1e-9)


def test_photos_of_other_kinds(folder, city):
    for path in (folder / "val/rgbs").iterdir():
        path.rename(path.with_suffix(".JPG"))
    scene = read_scene(folder)
    assert {view.name for view in scene.views if view.name in scene.held_out} == {
        "val/000001.JPG", "val/000006.JPG"}


def test_a_folder_without_val_or_mappings(folder):
    shutil.rmtree(folder / "val")
    (folder / "mappings.txt").unlink()
    scene = read_scene(folder)
    assert scene.held_out is None and len(scene.views) == 6


def archive(path, program, **storages):
    """A torch file of that pickle; storages: key -> bytes."""
    with zipfile.ZipFile(path, "w") as file:
        for key, content in {"data.pkl": program, **storages}.items():
            file.writestr(f"000000/{key}", content)
    return path


def test_what_torch_writes(tmp_path):
    """The writer of these tests is ours; this pickle is torch's own."""
    numbers = np.arange(20, dtype="<f4")
    path = tmp_path / "a.pt"
    archive(path, WRITTEN_BY_TORCH, **{f"data/{key}": part.tobytes() for key, part in zip(
        "012", (numbers[:12], numbers[12:16], numbers[16:]))})
    table = read_torch(path)
    assert list(table) == ["H", "W", "c2w", "intrinsics", "distortion"]
    assert (table["H"], table["W"]) == (3456, 4608)
    assert np.array_equal(table["c2w"], numbers[:12].reshape(3, 4))
    assert np.array_equal(table["distortion"], numbers[16:]) and table["c2w"].dtype == np.float32


def tensor(kind=b"torch\nDoubleStorage", count=6, offset=0, shape=(2, 2), strides=(1, 2)):
    """The pickle of a table with one tensor, "a", of data/0."""
    def whole(*numbers):
        return b"(" + b"".join(b"J" + struct.pack("<i", number) for number in numbers) + b"t"

    return (b"\x80\x02}X\1\0\0\0actorch._utils\n_rebuild_tensor_v2\n((X\7\0\0\0storagec" + kind
            + b"\nX\1\0\0\0" + b"0X\3\0\0\0cpuJ" + struct.pack("<i", count) + b"tQJ"
            + struct.pack("<i", offset) + whole(*shape) + whole(*strides)
            + b"\x89ccollections\nOrderedDict\n)RtRs.")


def test_views_of_a_storage(tmp_path):
    storage = {"data/0": np.arange(6.0).tobytes()}
    path = archive(tmp_path / "a.pt", tensor(offset=2), **storage)
    assert read_torch(path)["a"].tolist() == [[2, 4], [3, 5]]
    path = archive(tmp_path / "b.pt", tensor(shape=(), strides=(), offset=5), **storage)
    assert read_torch(path)["a"] == 5
    path = archive(tmp_path / "c.pt", tensor(shape=(0, 3)), **storage)
    assert read_torch(path)["a"].shape == (0, 3)


@pytest.mark.parametrize("program, words", [
    (tensor(offset=3), "buffer|bounds"),
    (tensor(strides=(1, 2**20)), "buffer|bounds"),
    (tensor(strides=(-1, 2)), "something else than numbers"),
    (tensor(offset=-1), "something else than numbers"),
    (tensor(shape=(3, 3), strides=(0, 0)), "larger than its storage"),
    (tensor(shape=(1,) * 40, strides=(1,) * 40), "something else than numbers"),
    (tensor(count=5), "not the bytes that are claimed"),
    (tensor(kind=b"torch\nBoolStorage"), "unknown kind"),
    (tensor(kind=b"os\nsystem"), "unknown kind"),
    (tensor().replace(b"tensor_v2", b"parameter"), "would call 'torch._utils _rebuild_parameter'"),
    (b"\x80\x02}N)s.", "than text is a key"),
    (b"\x80\x02]Na}.", "values to unpack"),
    (b"\x80\x02}}.", "too many values"),
    (b"\x80\x02Na.", "index"),
    (b"\x80\x02}(\x85s.", "more than it has put down"),
    (b"\x80\x02}", "pickle exhausted"),
    (b"\x80\x02h\5.", "5"),
    (b"I1\n.", "opcode INT"),
    (b"\x80\x02]N\x81.", "opcode NEWOBJ"),
])
def test_pickles_that_torch_does_not_write(tmp_path, program, words):
    path = archive(tmp_path / "a.pt", program, **{"data/0": np.arange(6.0).tobytes()})
    with pytest.raises(InputError, match=rf"a\.pt: not a torch file.*({words}).*copy it again"):
        read_torch(path)


class Harmful:
    def __init__(self, function, *arguments):
        self.call = function, arguments

    def __reduce__(self):
        return self.call


@pytest.mark.parametrize("protocol", [0, 2, 4])
@pytest.mark.parametrize("call", ["system", "eval", "import", "in a tensor's hooks"])
def test_code_in_a_pickle_is_not_run(tmp_path, folder, monkeypatch, protocol, call):
    """Unpickled by Python the same bytes do harm, which shows that they would."""
    harm = tmp_path / "harm"
    (tmp_path / "trap.py").write_text(f"open({str(harm)!r}, 'w')\ndef f(): pass\n")
    monkeypatch.syspath_prepend(tmp_path)
    code = f"open({str(harm)!r}, 'w')"
    if call == "import":
        program = b"ctrap\nf\n)R."
    elif call == "in a tensor's hooks":
        program = tensor()[:-2].replace(b"ccollections\nOrderedDict\n)R", pickle.dumps(
            Harmful(eval, code), 2)[2:-1]) + b"s."
    else:
        import os
        harmful = Harmful(os.system, f"touch {harm}") if call == "system" else Harmful(eval, code)
        program = pickle.dumps({"c2w": harmful}, protocol)
    archive(folder / "train/metadata/000000.pt", program,
            **{"data/0": np.arange(6.0).tobytes()})
    with pytest.raises(InputError, match=r"000000\.pt: not a torch file"):
        read_scene(folder)
    assert not harm.exists() and "trap" not in sys.modules
    if call != "in a tensor's hooks":
        pickle.loads(program)
        assert harm.exists()
    sys.modules.pop("trap", None)


def metadata(folder, **changes):
    values = {"H": 240, "W": 320, "c2w": np.eye(3, 4), "intrinsics": np.full(4, 100.0)}
    (folder / "train/metadata/000000.pt").write_bytes(torch_file({
        key: value for key, value in {**values, **changes}.items() if value is not None}))


def compressed(path):
    with zipfile.ZipFile(io.BytesIO(path.read_bytes())) as old:
        members = {key: old.read(key) for key in old.namelist()}
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as new:
        for key, content in members.items():
            new.writestr(key, content)


@pytest.mark.parametrize("spoil, words", [
    (lambda f: (f / "coordinates.pt").unlink(), "coordinates.pt: no such file"),
    (lambda f: (f / "coordinates.pt").write_bytes(torch_file({"origin_drb": np.zeros(3)})),
     "pose_scale_factor is missing"),
    (lambda f: metadata(f, c2w=np.eye(3)), r"000000.pt: c2w is missing, or no array of \[3, 4\]"),
    (lambda f: metadata(f, c2w=np.eye(3, 4) * [1, 1, 1, np.nan]), "c2w is missing, or no array"),
    (lambda f: metadata(f, c2w=np.ones((3, 4))), "000000.jpg is no rotation"),
    (lambda f: metadata(f, W="wide"), "W is missing, or no number"),
    (lambda f: metadata(f, H=480, W=640), "000000.jpg.*rescaled"),
    (lambda f: metadata(f, intrinsics=None), "intrinsics is missing"),
    (lambda f: metadata(f, intrinsics=np.zeros(4)), "no focal length"),
    (lambda f: shutil.rmtree(f / "train/metadata") or (f / "train/metadata").mkdir(),
     "train/metadata: holds no metadata"),
    (lambda f: (f / "train/metadata/000000.pt").unlink(), "1 of its 8 photos.*000000.pt"),
    (lambda f: (f / "val/rgbs/000001.jpg").unlink(), "val/rgbs/000001.jpg: no such image"),
    (lambda f: (f / "mappings.txt").write_bytes(b"\xff\xfe"), "mappings.txt: cannot be read"),
    (lambda f: (f / "val/metadata/000001.pt").write_bytes(b"PK\3\4"), "000001.pt.*no zip archive"),
    (lambda f: compressed(f / "val/metadata/000001.pt"), "000001.pt.*compressed"),
    (lambda f: archive(f / "coordinates.pt", b"\x80\x02}.", byteorder=b"big"), "big-endian"),
    (lambda f: archive(f / "coordinates.pt", b"\x80\x02]."), "holds no table of names"),
    (lambda f: (f / "coordinates.pt").write_bytes(b"0" * (2**24 + 1)), "more than 16 MB"),
])
def test_what_cannot_be_used(folder, spoil, words):
    spoil(folder)
    with pytest.raises(InputError, match=words) as caught:
        read_scene(folder)
    assert len(str(caught.value).splitlines()) == 1
