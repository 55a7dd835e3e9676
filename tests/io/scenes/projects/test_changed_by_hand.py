"""Projects that were changed by hand: every value of every file missing, or of another kind.

Each is read, or refused in one line that names the file.
"""

import copy
import json
import logging
import shutil
import warnings
from itertools import islice
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from clsplat.errors import InputError
from clsplat.io.scenes.read import read_scene
from tests.data import layouts, projects
from tests.data.tiny_model import reconstruction, write_scene

LENS = (40.0, 40.0, 23.0, 19.0, -0.1, 0.02, 1e-3, -2e-3, 0.01, 0.0, 0.0, 0.0)
GONE = object()
VALUES = (GONE, None, "x", "", -1, 0, 1e99, True, [], {}, [None], [[]], {"x": 1})
EVERY = 5  # of the variants that is read: all of them take two minutes
TEXTS = (GONE, "", "x", "-1", "0", "1e99", "nan", "1 2", "\u0663", "9" * 5000)


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """The folders of small projects, by their programs."""
    base = tmp_path_factory.mktemp("projects")
    model = reconstruction("FULL_OPENCV", LENS)
    for number in list(model.points3D)[6:]:
        model.delete_point3D(number)
    scene = read_scene(write_scene(base / "town", model))
    pinhole = read_scene(write_scene(base / "pinhole", reconstruction()))
    for name in ("opensfm", "metashape", "opf", "angles", "matrices", "xmp", "nerfstudio"):
        (base / name).mkdir()
    projects.write_opensfm(base / "opensfm", scene, (52.4, 16.9, 80.0))
    projects.write_metashape(base / "metashape", scene)
    projects.write_opf(base / "opf", scene)
    for form in ("angles", "matrices", "xmp"):
        projects.write_realityscan(base / form, scene, form)
    layouts.write_transforms(base / "nerfstudio", pinhole)
    return base


def read(folder):
    """Read a scene; warnings of numpy are errors, and whatever is not an InputError."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        try:
            scene = read_scene(folder)
        except InputError as error:
            assert "\n" not in str(error) and len(str(error)) < 1500, error
        else:
            assert all(np.isfinite(view.camera.translation).all() for view in scene.views)


def places(value, depth=0):
    """The paths to all values of JSON; of a list the first two and the last."""
    keys = value if isinstance(value, dict) else sorted(
        {*range(min(2, len(value))), len(value) - 1} - {-1}) if isinstance(value, list) else ()
    chosen = list(keys)[:12]
    for key in chosen:
        yield (key,)
        for rest in places(value[key], depth + 1):
            yield (key, *rest)


def changed(table, path, value):
    table = copy.deepcopy(table)
    owner = table
    for key in path[:-1]:
        owner = owner[key]
    if value is GONE:
        del owner[path[-1]]
    else:
        owner[path[-1]] = value
    return table


def sweep(original, folder, name, variants):
    """Read a copy of a project with each variant of one of its files."""
    shutil.copytree(original, folder)
    number = 0
    for number, (label, content) in enumerate(islice(variants, 0, None, EVERY)):
        (folder / name).write_bytes(content.encode("utf-8", "surrogatepass"))
        try:
            read(folder)
        except Exception as error:
            raise AssertionError(f"{name}: variant {number}, {label!r}") from error
    return number


def json_variants(text):
    table = json.loads(text)
    for path in places(table):
        for value in VALUES:
            yield f"{path} = {value!r}", json.dumps(changed(table, path, value))


FILES = [("opensfm", "reconstruction.json"), ("opf", "project.opf"), ("opf", "*.json"),
         ("opf", "tracks/*.gltf"), ("nerfstudio", "transforms.json")]


@pytest.mark.slow
@pytest.mark.parametrize("program, pattern", FILES)
def test_json(made, tmp_path, program, pattern, caplog):
    caplog.set_level(logging.ERROR)
    names = sorted(str(path.relative_to(made / program)) for path in (made / program).glob(pattern))
    assert names
    for number, name in enumerate(names):
        count = sweep(made / program, tmp_path / str(number), name,
                      json_variants((made / program / name).read_text()))
        assert count > 6


@pytest.mark.slow
@pytest.mark.parametrize("form", ["angles", "matrices"])
def test_csv(made, tmp_path, form, caplog):
    caplog.set_level(logging.ERROR)
    text = (made / form / "registration.csv").read_text()
    lines = text.splitlines()

    def variants():
        for row, line in enumerate(lines):
            cells = line.split(",")
            yield f"no line {row}", "\n".join([*lines[:row], *lines[row + 1:]])
            for column in range(len(cells)):
                for value in TEXTS:
                    new = cells[:column] + ([] if value is GONE else [value]) + cells[column + 1:]
                    yield f"{row}, {column}: {value!r:.20}", "\n".join(
                        [*lines[:row], ",".join(new), *lines[row + 1:]])

    sweep(made / form, tmp_path / form, "registration.csv", variants())


def xml_variants(text):
    root = ElementTree.fromstring(text)
    count = len(list(root.iter()))
    for number in range(count):
        for value in TEXTS:
            tree = ElementTree.fromstring(text)
            nodes = list(tree.iter())
            node = nodes[number]
            owner = next((each for each in nodes if node in list(each)), None)
            if value is GONE and owner is not None:
                owner.remove(node)
            elif value is not GONE:
                node.text = value
            yield f"{node.tag} = {value!r:.20}", ElementTree.tostring(tree, "unicode")
            for key in node.attrib if value is not GONE else ():
                tree = ElementTree.fromstring(text)
                list(tree.iter())[number].set(key, value)
                yield f"{node.tag}.{key} = {value!r:.20}", ElementTree.tostring(tree, "unicode")


@pytest.mark.slow
@pytest.mark.parametrize("program", ["metashape", "xmp"])
def test_xml(made, tmp_path, program, caplog):
    caplog.set_level(logging.ERROR)
    path = next(Path(made / program).rglob("*.xml" if program == "metashape" else "*.xmp"))
    name = str(path.relative_to(made / program))
    sweep(made / program, tmp_path / program, name, xml_variants(path.read_text()))
