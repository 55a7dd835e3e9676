"""Projects of other programs under fuzz."""

import numpy as np

from clsplat.io.scenes.read import read_scene
from tests.adversarial.fuzz.reader import Reader, usable
from tests.data import projects
from tests.data.layouts import write_ply
from tests.data.tiny_model import reconstruction, write_scene

LENS = (40.0, 40.0, 23.0, 19.0, -0.1, 0.02, 1e-3, -2e-3, 0.01, 0.0, 0.0, 0.0)
ON_EARTH = (1.0, np.eye(3), np.array([4.1e6, 6.3e5, 4.8e6]))  # geocentric, metres


def _scenes(folder):
    """A scene of a pinhole camera and one with a lens, with few points."""
    for model, parameters in (("PINHOLE", LENS[:4]), ("FULL_OPENCV", LENS)):
        made = reconstruction(model, parameters)
        for number in list(made.points3D)[12:]:
            made.delete_point3D(number)
        yield folder / f"town_{model}", read_scene(write_scene(folder / model, made))


def _opensfm(folder):
    for reference, (seed, scene) in zip((None, (52.4, 16.9, 80.0)), _scenes(folder)):
        projects.write_opensfm(seed, scene, reference)
        yield seed


def _metashape(folder):
    for reference, (seed, scene) in zip(("", "EPSG:4326"), _scenes(folder)):
        seed.mkdir()
        projects.write_metashape(seed, scene, reference=reference)
        if reference:
            path = seed / "cameras.xml"
            place = projects.texts(ON_EARTH[2])
            path.write_text(path.read_text().replace("<translation>0.0 0.0 0.0",
                                                     f"<translation>{place}"))
        else:
            write_ply(seed / "points3D.ply", scene.points, scene.colours)
        yield seed


def _realityscan(folder):
    for (seed, scene), forms in zip(_scenes(folder), (("angles", "xmp"), ("matrices", "xmp"))):
        for form in forms:
            (seed / form).mkdir(parents=True)
            projects.write_realityscan(seed / form, scene, form)
            write_ply(seed / form / "points3D.ply", scene.points, scene.colours)
            yield seed / form


def _opf(folder):
    for (seed, scene), crs in zip(_scenes(folder), ("EPSG:32632", 'ENGCRS["a"]')):
        seed.mkdir()
        projects.write_opf(seed, scene, crs)
        yield seed


def _scene(folder):
    usable(read_scene(folder))


READERS = {
    "opensfm": Reader(_opensfm, _scene, text=True, files=(".json", ".csv")),
    "metashape": Reader(_metashape, _scene, text=True, files=(".xml",)),
    "realityscan": Reader(_realityscan, _scene, text=True, files=(".csv", ".xmp")),
    "opf": Reader(_opf, _scene, text=True, files=(".opf", ".json", ".gltf", ".bin")),
}
