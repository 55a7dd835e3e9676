"""SOG whose meta data does not fit, and one that has its textures in a folder of the zip."""

import json
import zipfile

import pytest

from clsplat.errors import InputError
from clsplat.io.models.formats import read_model, write_model
from tests.io.models.test_ply import equal, random_gaussians


@pytest.fixture
def members(tmp_path):
    """The content of each member of a SOG."""
    write_model(tmp_path / "whole.sog", random_gaussians(30))
    with zipfile.ZipFile(tmp_path / "whole.sog") as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def zipped(path, members):
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    return path


def test_a_zip_with_a_folder(tmp_path, members):
    path = zipped(tmp_path / "inner.sog", {f"top/{name}": members[name] for name in members})
    assert equal(read_model(path), read_model(tmp_path / "whole.sog"))


@pytest.mark.parametrize(
    "change, words",
    [
        (lambda meta: meta.pop("version"), "another version is not read"),
        (lambda meta: meta.update(version=3), "another version is not read"),
        (lambda meta: meta.update(count=-1), "count is not"),
        (lambda meta: meta.update(count=1e9), "count is not"),
        (lambda meta: meta.update(count=True), "count is not"),
        (lambda meta: meta.update(count=31 * 31), "pixels for"),
        (lambda meta: meta["sh0"].update(files=["gone.webp"]), "damaged"),
        (lambda meta: meta["sh0"].update(files="sh0.webp"), "damaged"),
        (lambda meta: meta["shN"].update(bands=4), "damaged"),
        (lambda meta: meta["shN"].update(files=["shN_labels.webp"]), "damaged"),
        (lambda meta: meta.pop("quats"), "damaged"),
    ],
)
def test_what_does_not_fit(tmp_path, members, change, words):
    meta = json.loads(members["meta.json"])
    change(meta)
    path = zipped(tmp_path / "a.sog", {**members, "meta.json": json.dumps(meta)})
    with pytest.raises(InputError, match=words):
        read_model(path)
