"""The pipeline: refusals, what is kept of a killed reconstruction, and a whole one."""

import json
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import OpenImageIO as oiio
import pytest

from clsplat.errors import InputError
from clsplat.io.photos.images import read_image
from clsplat.io.scenes.read import read_scene
from clsplat.sfm import reconstruct as module
from clsplat.sfm.photos import find_photos
from clsplat.sfm.reconstruct import SfmOptions, Unfinished, is_finished, reconstruct
from tests.command_line import clsplat_
from tests.data.tiny_training import CITY
from tests.sfm.cases import Lines, folder_of, source, synthetic

LATITUDE, LONGITUDE = 45.0, 9.0  # of the sample city: on the middle meridian of UTM zone 32
NORTHING = 4_982_950.4  # of the sample city's origin in that zone
METRES_PER_DEGREE = 111132.0, 78847.0  # of latitude and longitude there


def photos_of(tmp_path):
    return folder_of(tmp_path / "in", ["a.jpg", "b.jpg", "c.jpg"])


def finished(folder, *names):
    """A scene that `clsplat sfm` has made."""
    folder_of(folder / "images", names)
    (folder / "sfm.json").write_text("{}")
    return folder


@pytest.mark.parametrize(
    "source, words",
    [
        ("typo", "no such folder"),
        ("typo.mp4", "no such file|needs PyAV"),
        ("few", "a reconstruction needs at least 3"),
        ("out/images", "out/images: is in .*/out, who"),
    ],
)
def test_a_scene_is_replaced_only_if_there_are_photos(tmp_path, source, words):
    output = finished(tmp_path / "out", "a.jpg", "b.jpg", "c.jpg")
    folder_of(tmp_path / "few", ["a.jpg"])
    with pytest.raises(InputError, match=words):
        reconstruct(tmp_path / source, output, SfmOptions(), Lines(), overwrite=True)
    with pytest.raises(InputError, match="out/images: is in .*/out, whose files are replaced"):
        reconstruct(photos_of(tmp_path), output, SfmOptions(output / "images"), Lines(), True)
    assert len(list((output / "images").iterdir())) == 3 and (output / "sfm.json").exists()


def test_photos_without_detail_are_refused_in_one_line(tmp_path):
    result = clsplat_("sfm", photos_of(tmp_path), "-o", tmp_path / "out")
    assert result.exit_code == 2
    assert f"error: {tmp_path / 'out'}: no photos could be placed" in result.output


def test_a_scene_whose_place_was_asked_for_is_kept_without_it(tmp_path, monkeypatch):
    """The same command, corrected, goes on."""
    model = synthetic()
    photos = folder_of(tmp_path / "in", [f"{index}.jpg" for index in range(6)], size=(320, 240))
    mapped = []

    monkeypatch.setattr(module, "map_photos", lambda *_: (mapped.append(1), model)[1])
    for _ in range(2):
        result = clsplat_("sfm", "-q", photos, "-o", tmp_path / "out", "--crs", "EPSG:32632")
        assert result.exit_code == 2 and result.output.count("\n") == 1
        assert "the scene is complete, but not georeferenced: no photo has GPS;" in result.output
        assert len(read_scene(tmp_path / "out").views) == 6
    assert clsplat_("sfm", "-q", photos, "-o", tmp_path / "out").output == ""
    assert not (tmp_path / "out/.sfm").exists() and len(mapped) == 1
    assert "holds a reconstructed scene already" in clsplat_("sfm", photos, "-o", tmp_path / "out").output


def test_what_is_kept_belongs_to_the_same_photos_and_options(tmp_path):
    photos, _ = find_photos(photos_of(tmp_path))
    (tmp_path / "scene").mkdir()
    kept = Unfinished(tmp_path / "scene")
    kept.open(photos, {"matching": "auto"}, False)
    database = kept.folder / "database.db"
    database.write_bytes(b"features")
    kept.open(photos, {"matching": "auto"}, False)
    assert database.exists()
    for others, options in ((photos[:2], {"matching": "auto"}), (photos, {"matching": "all"})):
        with pytest.raises(InputError, match="of other photos or with other options"):
            kept.open(others, options, False)
    kept.open(photos[:2], {"matching": "auto"}, True)
    assert not database.exists()


def test_mapping_is_kept(tmp_path):
    kept = Unfinished(tmp_path)
    kept.keep(synthetic(), [source(f"{index} a.jpg") for index in range(6)])
    assert kept.has_model and kept.model().num_points3D() == 60
    assert {image.name for image in kept.model().images.values()} == {f"{index} a.jpg" for index in range(6)}


def test_train_makes_a_scene_of_photos_once(tmp_path, monkeypatch):
    photos, run = photos_of(tmp_path), tmp_path / "run"
    asked = []

    def made(source, output, options, progress, overwrite):
        asked.append((source, output))
        output.mkdir()
        (output / "sfm.json").write_text(json.dumps({"source": str(source.resolve()), "photos": 3}))
        raise InputError("enough")

    monkeypatch.setattr("clsplat.sfm.reconstruct.reconstruct", made)
    for options, words in ((("--test-offset", 9), "--test-offset"), ((), "already holds a run")):
        if not options:  # the cheap checks come before the long work
            (tmp_path / "taken").mkdir()
            (tmp_path / "taken" / "point_cloud.ply").touch()
        result = clsplat_("train", photos, "-o", tmp_path / "taken", *options)
        assert result.exit_code == 2 and words in result.output and not asked
    result = clsplat_("train", photos, "-o", run)
    assert "photos without poses; makes a scene in" in result.output
    assert asked == [(photos, tmp_path / "run_scene")]
    result = clsplat_("train", photos, "-o", run)  # the scene has no model, as nothing made one
    assert len(asked) == 1 and "no COLMAP model" in result.output
    other = folder_of(tmp_path / "other", ["a.jpg"])
    assert "was made of" in clsplat_("train", other, "-o", run).output
    assert is_finished(tmp_path / "run_scene", photos)
    folder_of(photos, ["north/d.jpg"])
    result = clsplat_("train", photos, "-o", run)
    assert result.exit_code == 2
    assert f"was made of 3 photos of {photos}, which now has 4; remove it" in result.output


def copied_city(folder, count=12):
    """Photos of the sample city with GPS, whose heights are those of the city plus 100 m; and the
    true scene."""
    scene = read_scene(CITY)
    folder.mkdir()
    for view in scene.views[:count]:
        east, north, up = view.camera.position + scene.offset
        pixels = read_image(view.source)
        spec = oiio.ImageSpec(pixels.shape[1], pixels.shape[0], 3, oiio.UINT8)
        spec.attribute("Compression", "jpeg:97")
        spec.attribute("Exif:FocalLengthIn35mmFilm", 30)
        for name, value, reference in (
            ("Latitude", LATITUDE + north / METRES_PER_DEGREE[0], "N"),
            ("Longitude", LONGITUDE + east / METRES_PER_DEGREE[1], "E"),
        ):
            minutes, seconds = divmod(value % 1 * 3600, 60)
            spec.attribute(f"GPS:{name}", oiio.TypeDesc("float[3]"), (float(int(value)), minutes, seconds))
            spec.attribute(f"GPS:{name}Ref", reference)
        spec.attribute("GPS:Altitude", float(up + 100))
        path = str((folder / view.name).with_suffix(".jpg"))
        output = oiio.ImageOutput.create(path)
        assert output.open(path, spec) and output.write_image(pixels) and output.close()
    return scene


def killed(words, waited_for):
    """A command whose process is killed once a file of its scene is there."""
    output = words[words.index("-o") + 1]
    process = subprocess.Popen(
        [sys.executable, "-m", "clsplat", *map(str, words)], stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL
    )
    while not (output / waited_for).exists():
        assert process.poll() is None
        time.sleep(0.01)
    process.kill()
    process.wait()
    assert not (output / "sfm.json").exists()


@pytest.mark.nightly
def test_a_reconstruction_killed_at_any_place_continues_and_ends_in_metres(tmp_path):
    truth = copied_city(tmp_path / "in")
    words = "sfm", tmp_path / "in", "-o", tmp_path / "out"
    for waited_for in (".sfm/database.db", ".sfm/global", ".sfm/triangulation", "images"):
        killed(words, waited_for)
    assert clsplat_(*words).exit_code == 0
    record = json.loads((tmp_path / "out/sfm.json").read_text())
    assert record["registered"] == record["photos"] == 12
    assert record["reprojection_error_pixels"] < 0.5 and record["not_registered"] == {}
    assert not (tmp_path / "out/.sfm").exists()
    scene = read_scene(tmp_path / "out")
    assert scene.georeference.crs == "EPSG:32632" and scene.georeference.residual < 1
    assert scene.up.tolist() == [0, 0, 1]
    found, true = (
        np.array([view.camera.position + whole.offset for view in whole.views[:12]]) for whole in (scene, truth)
    )
    away = found + scene.georeference.offset - found.mean(axis=0) - (true - true.mean(axis=0))
    away -= away.mean(axis=0)
    # twelve small photos from one height leave the focal length, and so the bending, uncertain
    assert np.linalg.norm(away, axis=1).max() < 0.04 * np.ptp(true, axis=0).max()


def control_file(path, truth, count, marked):
    """Points of the sample city that are marked in photos, by the true cameras, as CSV; every third
    is a check point. Their names."""
    views, lines = truth.views[:count], ["EPSG:32632", "name,x,y,z,pixel_x,pixel_y,image"]
    seen = np.array([view.sees(truth.points) for view in views])
    often = np.flatnonzero(seen.sum(axis=0) >= 4)
    chosen = often[:: max(1, len(often) // marked)][:marked]
    for number in chosen:
        east, north, up = truth.points[number] + truth.offset
        for view in (view for view, sees in zip(views, seen[:, number]) if sees):
            x, y = view.camera.project(truth.points[[number]])[0][0]
            lines.append(
                f"P{number},{east + 500_000},{north + NORTHING},{up + 100},{x},{y},"
                f"{Path(view.name).with_suffix('.jpg')}"
            )
    path.write_text("\n".join(lines) + "\n")
    return [f"P{number}" for number in chosen]


@pytest.mark.slow
def test_control_points_take_out_the_bending_after_a_kill(tmp_path):
    """The twelve photos of above, whose focal length is uncertain; the residual was 0.13 m."""
    truth = copied_city(tmp_path / "in")
    names = control_file(tmp_path / "gcp.csv", truth, 12, 15)
    checks = [word for name in names[2::3] for word in ("--check-point", name)]
    words = ("sfm", tmp_path / "in", "-o", tmp_path / "out", "--gcp", tmp_path / "gcp.csv", *checks)
    killed(words, ".sfm/global")
    result = clsplat_(*words)
    assert result.exit_code == 0 and "5 check points, which took no part" in result.output
    record = json.loads((tmp_path / "out/sfm.json").read_text())
    assert record["registered"] == record["photos"] == 12 and record["not_registered"] == {}
    assert record["reprojection_error_pixels"] < 0.5 and not (tmp_path / "out/.sfm").exists()
    roles = [each["role"] for each in record["control_points"]]
    assert roles.count("control") == 10 and roles.count("check") == 5
    scene = read_scene(tmp_path / "out")
    assert scene.georeference.residual < 0.05 and scene.georeference.offset[2] > 90
    assert scene.georeference.crs == "EPSG:32632" and scene.up.tolist() == [0, 0, 1]
    found, true = (
        np.array([view.camera.position + whole.offset for view in whole.views[:12]]) for whole in (scene, truth)
    )
    away = found + scene.georeference.offset - true - (500_000, NORTHING, 100)
    assert np.linalg.norm(away, axis=1).max() < 0.4
