"""`clsplat pack`: what is copied, and what is left alone."""

from click.testing import CliRunner

from clsplat.cli.main import main
from clsplat.io.scenes.read import read_scene
from tests.data.tiny_model import write_scene


def pack(*words):
    result = CliRunner().invoke(main, ["pack", *map(str, words)])
    return result.exit_code, result.output


def test_a_scene_is_copied(tmp_path):
    folder = write_scene(tmp_path / "town")
    code, said = pack(folder, "-o", tmp_path / "copy")
    assert code == 0 and "4 photos" in said
    read = read_scene(tmp_path / "copy")
    assert len(read.views) == 4 and len(read.points) == 30
    assert not any(view.source.is_symlink() for view in read.views)
    assert pack(folder, "-o", tmp_path / "half", "-r", "2")[0] == 0
    assert read_scene(tmp_path / "half").views[0].camera.width == 24


def test_nothing_is_replaced(tmp_path):
    folder = write_scene(tmp_path / "town")
    (tmp_path / "copy").mkdir()
    (tmp_path / "copy" / "letter.txt").write_text("mine")
    code, said = pack(folder, "-o", tmp_path / "copy")
    assert code == 2 and "exists already" in said and said.count("\n") == 1
    code, said = pack(folder, "-o", tmp_path / "other", "--images", "images_2")
    assert code == 2 and "images_2" in said and not (tmp_path / "other").exists()
