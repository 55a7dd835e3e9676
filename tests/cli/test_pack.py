"""`clsplat pack`: what is packed, and what is left alone."""

from click.testing import CliRunner

from clsplat.cli.main import main
from clsplat.errors import InputError
from clsplat.io.scenes.read import fingerprint, read_scene
from clsplat.synth.write import GEOMETRY
from tests.data.tiny_model import write_scene


def pack(*words):
    result = CliRunner().invoke(main, ["pack", *map(str, words)])
    return result.exit_code, result.output


def test_a_scene_is_packed_with_its_geometry(tmp_path):
    folder = write_scene(tmp_path / "town")
    (folder / GEOMETRY).write_text("{}")
    code, said = pack(folder, "-o", tmp_path / "town.npz")
    assert code == 0 and "4 photos" in said
    assert fingerprint(read_scene(tmp_path / "town.npz")) == fingerprint(read_scene(folder))
    assert (tmp_path / f"town.{GEOMETRY}").read_text() == "{}"
    assert pack(folder, "-o", tmp_path / "half.npz", "-r", "2")[0] == 0
    assert read_scene(tmp_path / "half.npz").views[0].camera.width == 24


def test_both_files_are_there_or_none(tmp_path, monkeypatch):
    def full(*_):
        raise InputError("town.npz: cannot be written")
    folder = write_scene(tmp_path / "town")
    (folder / GEOMETRY).write_text("{}")
    with monkeypatch.context() as patch:
        patch.setattr("clsplat.io.scenes.packed.write_packed", full)
        assert pack(folder, "-o", tmp_path / "town.npz")[0] == 2
    assert [path.name for path in tmp_path.iterdir()] == ["town"]
    (tmp_path / f"town.{GEOMETRY}").write_text("mine")
    code, said = pack(folder, "-o", tmp_path / "town.npz")
    assert code == 2 and "--overwrite" in said and not (tmp_path / "town.npz").exists()


def test_nothing_is_replaced_unless_asked(tmp_path):
    folder = write_scene(tmp_path / "town")
    (tmp_path / "town.npz").write_text("mine")
    code, said = pack(folder, "-o", tmp_path / "town.npz")
    assert code == 2 and "--overwrite" in said and said.count("\n") == 1
    assert (tmp_path / "town.npz").read_text() == "mine"
    assert pack(folder, "-o", tmp_path / "town.npz", "--overwrite")[0] == 0
    code, said = pack(folder, "-o", tmp_path / "town.zip")
    assert code == 2 and ".npz" in said
    code, said = pack(folder, "-o", tmp_path / "none" / "town.npz")
    assert code == 2 and "cannot be written" in said


def test_the_folder_of_photos_is_an_option(tmp_path):
    folder = write_scene(tmp_path / "town")
    (folder / "images").rename(folder / "photos")
    assert pack(folder, "-o", tmp_path / "town.npz", "--images", "photos")[0] == 0
    code, said = pack(folder, "-o", tmp_path / "other.npz", "--images", "images_2")
    assert code == 2 and "images_2" in said and not (tmp_path / "other.npz").exists()
