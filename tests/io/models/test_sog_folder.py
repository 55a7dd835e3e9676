"""SOG that is not one zip of textures: in a folder, in a zip's folder, of another version."""

import json
import zipfile

import pytest

from clsplat.errors import InputError
from clsplat.io.models.formats import count_of, is_model, read_model, read_with_notes, write_model
from tests.io.models.test_ply import equal, random_gaussians


@pytest.fixture
def folder(tmp_path):
    """The members of a SOG as files."""
    write_model(tmp_path / "whole.sog", random_gaussians(30))
    with zipfile.ZipFile(tmp_path / "whole.sog") as archive:
        archive.extractall(tmp_path / "folder")
    return tmp_path / "folder"


def test_a_folder_and_its_meta(folder):
    whole = read_model(folder.parent / "whole.sog")
    for path in (folder, folder / "meta.json"):
        assert is_model(path) and equal(read_model(path), whole)
        assert count_of(path) == 30 and not read_with_notes(path)[1].antialiased
    assert not is_model(folder.parent)
    with pytest.raises(InputError, match="unknown suffix '.json'"):
        write_model(folder / "meta.json", whole)


def test_a_zip_with_a_folder(folder):
    path = folder.parent / "inner.sog"
    with zipfile.ZipFile(path, "w") as archive:
        archive.mkdir("top") if hasattr(archive, "mkdir") else None
        for file in sorted(folder.iterdir()):
            archive.write(file, f"top/{file.name}")
    assert equal(read_model(path), read_model(folder))


@pytest.mark.parametrize("change, words", [
    (lambda meta: meta.pop("version"), "SOG of version 1, which is not read"),
    (lambda meta: meta.update(version=3), "SOG of version 3, which is not read"),
    (lambda meta: meta.update(count=-1), "count is not"), (lambda meta: meta.update(count=1e9),
                                                           "count is not"),
    (lambda meta: meta.update(count=True), "count is not"),
    (lambda meta: meta.update(count=31 * 31), "pixels for"),
    (lambda meta: meta["sh0"].update(files=["gone.webp"]), "no such file"),
    (lambda meta: meta["sh0"].update(files="sh0.webp"), "sh0 has not 1 textures"),
    (lambda meta: meta["shN"].update(bands=4), "damaged"),
    (lambda meta: meta["shN"].update(files=["shN_labels.webp"]), "shN has not 2 textures"),
    (lambda meta: meta.pop("quats"), "damaged"),
])
def test_what_does_not_fit(folder, change, words):
    meta = json.loads((folder / "meta.json").read_text())
    change(meta)
    (folder / "meta.json").write_text(json.dumps(meta))
    with pytest.raises(InputError, match=words):
        read_model(folder)
