"""Readers of scenes that other packages register."""

import sys

import pytest

from clsplat.errors import InputError
from clsplat.io.scenes.read import is_scene, read_scene
from tests.data.tiny_model import write_scene

READER = """
from clsplat.io.scenes.read import read_scene
def find(path):
    return next(iter(path.glob("*.town")), None) if path.is_dir() else None
def read(file, images):
    return read_scene(file.parent / file.read_text(), images)
"""


@pytest.fixture
def register(tmp_path, monkeypatch):
    """A function that registers a module of this text."""

    def install(text, entry="town = town_reader"):
        (tmp_path / "town_reader.py").write_text(text)
        info = tmp_path / "town-1.dist-info"
        info.mkdir()
        (info / "METADATA").write_text("Metadata-Version: 2.1\nName: town\nVersion: 1\n")
        (info / "entry_points.txt").write_text(f"[clsplat.scenes]\n{entry}\n")
        monkeypatch.syspath_prepend(str(tmp_path))
        monkeypatch.delitem(sys.modules, "town_reader", raising=False)

    return install


def test_a_registered_reader_is_imported_where_no_other_fits(tmp_path, register):
    register(READER)
    made = write_scene(tmp_path / "made")
    assert len(read_scene(made).views) == 4 and "town_reader" not in sys.modules
    (tmp_path / "own").mkdir()
    assert not is_scene(tmp_path / "own")
    (tmp_path / "own/a.town").write_text("../made")
    assert is_scene(tmp_path / "own")
    scene = read_scene(tmp_path / "own")
    assert len(scene.views) == 4 and scene.path == tmp_path / "own"


@pytest.mark.parametrize(
    "text, entry",
    [
        ("import missing_module", "town = town_reader"),
        ("", "town = town_reader"),
        (READER, "town = town_reader:Missing"),
    ],
)
def test_a_reader_that_does_not_load_is_named(tmp_path, register, text, entry):
    register(text, entry)
    (tmp_path / "own").mkdir()
    with pytest.raises(InputError, match="town_reader.*cannot be loaded as a reader of scenes"):
        read_scene(tmp_path / "own")
