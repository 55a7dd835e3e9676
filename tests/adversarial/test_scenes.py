"""Scene folders as they come: from other systems, half copied, made by hand or by an enemy.

Each case changes a healthy scene; it is then read right, or refused in one line that says what to
do. Everything here is read without a device.
"""

import os
import shutil
import struct
import subprocess
import sys
import unicodedata

import numpy as np
import pycolmap
import pytest
from PIL import Image

from clsplat.errors import InputError
from clsplat.io.photos.images import write_image
from clsplat.io.photos.views import read_photo
from clsplat.io.scenes.packed import write_packed
from clsplat.io.scenes.read import fingerprint, read_scene
from tests.adversarial.test_photos import exif
from tests.data import layouts
from tests.data.tiny_model import CENTRE, FOCAL, HEIGHT, WIDTH, reconstruction, write_scene


def renamed(change, text=False):
    """A scene whose photos have other names."""
    def make(folder):
        made = reconstruction()
        for image in made.images.values():
            image.name = change(image.name)
        for image in made.images.values():
            (folder / "images" / image.name).parent.mkdir(parents=True, exist_ok=True)
        return write_scene(folder, made, text)
    return make


def shrunk(folder, name, factor, numbers=range(4)):
    """The photos again, `factor` times smaller, in folder/name."""
    (folder / name).mkdir(exist_ok=True)
    for number in numbers:
        size = round(WIDTH / factor), round(HEIGHT / factor)
        Image.new("RGB", size, (number, 0, 0)).save(folder / name / f"photo_{number}.png")


def sizes(scene):
    return {(view.camera.width, view.camera.height) for view in scene.views}


def refused(path, *words, images=""):
    with pytest.raises(InputError) as caught:
        read_scene(path, images)
    line = str(caught.value)
    assert "\n" not in line and ";" in line
    for word in words:
        assert word in line, line


NAMES = {
    "blanks": (lambda name: f"my photo {name}", False),
    "blanks, text model": (lambda name: f"my  photo {name}", True),
    "umlauts": (lambda name: f"Straße {name}", False),
    "umlauts, text model": (lambda name: f"Straße {name}", True),
    "decomposed": (lambda name: unicodedata.normalize("NFD", f"é{name}"), False),
    "folders": (lambda name: f"drone 1/day-2/{name}", True),
    "quotes": (lambda name: f"it's \" $(x) %s {{}} {name}", True),
    "right to left": (lambda name: f"\u05d0\u05d1{name}", False),
    "a leading dash": (lambda name: f"-rf {name}", False),
    "a leading dot": (lambda name: f".{name}", False),
    "emoji": (lambda name: f"\U0001f6f0{name}", True),
    "no suffix in common": (lambda name: f"{name}.backup.png", False),
    "245 bytes": (lambda name: "n" * (245 - len(name)) + name, False),
}


@pytest.mark.parametrize("case", NAMES)
def test_names(tmp_path, case):
    change, text = NAMES[case]
    scene = read_scene(renamed(change, text)(tmp_path / "town"))
    assert [view.name for view in scene.views] == [change(f"photo_{i}.png") for i in range(4)]
    assert all(read_photo(view).shape == (HEIGHT, WIDTH, 3) for view in scene.views)


@pytest.mark.parametrize("name, words", [
    ("n" * 247 + ".png", ("too long", "rename")),
    ("folder/" + "n" * 247 + ".png", ("too long", "rename")),
    ("../photo.png", ("leaves the scene's image folder",)),
    ("/etc/passwd", ("leaves the scene's image folder",)),
    ("a\\..\\..\\photo.png", ("leaves the scene's image folder",)),
    ("a\x1b[31m.png", ("not valid text", "rename")),
    ("a\u2028b.png", ("not valid text",)),
    ("a\nb.png", ("not valid text",)),
    (".", ("leaves",)),
])
def test_names_that_are_refused(tmp_path, name, words):
    folder = write_scene(tmp_path / "town")
    made = reconstruction()
    next(iter(made.images.values())).name = name
    made.write_binary(str(folder / "sparse" / "0"))
    refused(folder, *words)


def test_a_view_that_trains_can_be_evaluated(tmp_path):
    """A picture is written as NAME.png.part, which no file system takes beyond 255 bytes."""
    longest = renamed(lambda name: "n" * (245 - len(name)) + name)(tmp_path / "town")
    name = read_scene(longest).views[0].name
    write_image(tmp_path / f"{name}.png", np.zeros((4, 4, 3), np.uint8))
    refused(renamed(lambda name: "n" * (246 - len(name)) + name)(tmp_path / "city"), "too long")


PHOTO = "images/photo_1.png"
SCENES = {
    "other case": (lambda f: (f / PHOTO).rename(f / "images/Photo_1.PNG"),
                   ("1 of 4", "letter case")),
    "decomposed on disk": (lambda f: [renamed(lambda n: f"é{n}")(f)] + [
        path.rename(path.with_name(unicodedata.normalize("NFD", path.name)))
        for path in (f / "images").glob("é*")], ("4 of 4", "form of its characters")),
    "other suffix": (lambda f: (f / PHOTO).rename(f / "images/photo_1.jpg"),
                     ("1 of 4", "another suffix")),
    "photo is a pipe": (lambda f: ((f / PHOTO).unlink(), os.mkfifo(f / PHOTO)), ("a pipe",)),
    "photo is a device": (lambda f: ((f / PHOTO).unlink(), (f / PHOTO).symlink_to("/dev/zero")),
                          ("a device",)),
    "photo is a folder": (lambda f: ((f / PHOTO).unlink(), (f / PHOTO).mkdir()), ("a folder",)),
    "images is a file": (lambda f: (shutil.rmtree(f / "images"), (f / "images").write_text("")),
                         ("4 of 4",)),
    "images is a link to itself": (lambda f: (shutil.rmtree(f / "images"), (
        f / "images").symlink_to(f / "images")), ("4 of 4",)),
    "one photo smaller": (lambda f: shrunk(f, "images", 2, [1]), ("rescaled", "--images")),
    "all photos smaller": (lambda f: shrunk(f, "images", 2), ("rescaled", "--images")),
    "EXIF turned": (lambda f: Image.new("RGB", (HEIGHT, WIDTH)).save(f / PHOTO, exif=exif(6)),
                    ("EXIF orientation 6", "-auto-orient")),
    "cameras is a pipe": (lambda f: [(f / f"sparse/0/{n}").unlink() for n in (
        "cameras.bin",)] + [os.mkfifo(f / "sparse/0/cameras.bin")], ("cameras.bin",)),
    "points is a device": (lambda f: [(f / "sparse/0/points3D.bin").unlink(), (
        f / "sparse/0/points3D.bin").symlink_to("/dev/zero")], ("points3D.bin",)),
    "model is a file": (lambda f: [shutil.rmtree(f / "sparse"), (f / "sparse").write_text("")],
                        ("no COLMAP model", "docs/guide/photos.md")),
    "only a Git LFS pointer": (lambda f: (f / "sparse/0/images.bin").write_text(
        "version https://git-lfs.github.com/spec/v1\n"), ("images.bin", "copy the model again")),
    "half the model is text": (lambda f: (f / "sparse/0/images.bin").rename(
        f / "sparse/0/images.txt"), ("images.bin", "missing")),
    "photos smaller by two factors": (lambda f: (
        shrunk(f, "images_2", 2), shrunk(f, "images_2", 3, [2]),
        shutil.rmtree(f / "images")), ("photo_2.png", "16x12", "2 times smaller")),
    "a photo missing in images_2": (lambda f: (
        shrunk(f, "images_2", 2, range(3)), shutil.rmtree(f / "images")), ("1 of 4",)),
}


@pytest.mark.parametrize("case", SCENES)
def test_scenes_that_are_refused(tmp_path, case):
    spoil, words = SCENES[case]
    folder = write_scene(tmp_path / "town")
    spoil(folder)
    refused(folder, *words)


@pytest.mark.parametrize("spoil", [
    lambda f: (f / "rigs.bin").write_bytes(bytes(range(256)) * 9),
    lambda f: (f / "frames.bin").write_bytes(b"\xff" * 999), lambda f: (f / "rigs.bin").unlink(),
    lambda f: (f / "frames.bin").unlink()])
def test_rigs_and_frames_are_not_needed(tmp_path, spoil):
    """Images hold their own poses."""
    folder = write_scene(tmp_path / "town")
    whole = read_scene(folder)
    spoil(folder / "sparse/0")
    assert fingerprint(read_scene(folder)) == fingerprint(whole)


@pytest.mark.parametrize("name, factor", [("images_2", 2), ("images_3", 3), ("images_7", 7)])
def test_smaller_photos_scale_the_cameras(tmp_path, name, factor):
    folder = write_scene(tmp_path / "town")
    shrunk(folder, name, factor)
    size = round(WIDTH / factor), round(HEIGHT / factor)
    assert sizes(read_scene(folder)) == {(WIDTH, HEIGHT)}, "images/ comes first"
    asked = read_scene(folder, name)
    shutil.rmtree(folder / "images")
    shrunk(folder, "images_8", 8)
    for scene in (asked, read_scene(folder)):  # the largest there are
        camera = scene.views[2].camera
        scale = np.array(size) / (WIDTH, HEIGHT)
        assert (camera.width, camera.height) == size
        assert np.allclose(camera.focal, FOCAL * scale)
        assert np.allclose(camera.centre, CENTRE * scale)
        note, = scene.notes
        assert f"{name}/" in note and "times smaller" in note
        assert read_photo(scene.views[2])[0, 0, 0] == 2
    refused(folder, "--images images_9", "images_8", images="images_9")
    refused(folder, "--images", "UTF-8", images="\udcff")


def test_a_folder_of_photos_elsewhere(tmp_path):
    folder = write_scene(tmp_path / "town")
    (folder / "images").rename(tmp_path / "photos")
    for images in ("../photos", str(tmp_path / "photos")):
        scene = read_scene(folder, images)
        assert sizes(scene) == {(WIDTH, HEIGHT)} and "photos/" in scene.notes[0]
    write_packed(scene, tmp_path / "town.npz")
    refused(tmp_path / "town.npz", "--images photos", "a packed scene", images="photos")


def test_the_largest_model_is_used_and_told(tmp_path):
    folder = write_scene(tmp_path / "town")
    assert read_scene(folder).notes == ()
    small = reconstruction()
    for frame in list(small.reg_frame_ids())[2:]:
        small.deregister_frame(frame)
    (folder / "sparse/1").mkdir()
    small.write_binary(str(folder / "sparse/1"))
    assert read_scene(folder).notes == ()
    (folder / "sparse/0").rename(folder / "sparse/10")
    scene = read_scene(folder)
    assert len(scene.views) == 4 and "sparse/10 is used, with 4" in scene.notes[0]
    (folder / "sparse/1").rename(folder / "sparse/0")
    scene = read_scene(folder)
    assert len(scene.views) == 2 and "sparse/10 has 4" in scene.notes[0]


def test_notes_on_photos(tmp_path):
    folder = write_scene(tmp_path / "town")
    Image.new("RGBA", (WIDTH, HEIGHT)).save(folder / PHOTO)
    Image.new("RGB", (WIDTH, HEIGHT)).save(folder / "images/photo_2.png", exif=exif(3))
    alpha, turned = read_scene(folder).notes
    assert alpha.startswith("1 of 4 photos have an alpha channel: transparent pixels are")
    assert turned.startswith("1 of 4 photos have an EXIF orientation")


@pytest.mark.skipif(sys.platform == "win32", reason="names are Unicode there")
@pytest.mark.parametrize("locale", [{}, {"PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0",
                                         "LC_ALL": "C"}])
@pytest.mark.slow
def test_paths_that_are_not_utf8(tmp_path, locale):
    """Neither the path of the scene nor the names in it."""
    made = renamed(lambda name: f"ü {name}")(tmp_path / "town")
    place = os.path.join(os.fsencode(tmp_path), b"t\xffwn")
    shutil.move(made, place)
    code = ("import sys\nfrom clsplat.io.photos.views import read_photo\n"
            "from clsplat.io.scenes.packed import write_packed\n"
            "from clsplat.io.scenes.read import read_scene\n"
            "scene = read_scene(sys.argv[1])\n"
            "print(sum(read_photo(view).shape[0] for view in scene.views))\n"
            "write_packed(scene, sys.argv[1] + '/a.npz')\n"
            "print(len(read_scene(sys.argv[1] + '/a.npz').views))\n"
            "from clsplat.io.runs.run import RunFolder\nrun = RunFolder(sys.argv[1] + '/run')\n"
            "names = [view.name for view in scene.views]\nrun.renders.note('test', names)\n"
            "for name in names:\n    run.renders.path('test', name).touch()\n"
            "run.renders.note('train', [])\nprint(len(run.renders.paths()))\n")
    done = subprocess.run([sys.executable, "-c", code, place], env={**os.environ, **locale},
                          capture_output=True, text=True, timeout=300, check=False)
    assert done.stdout.split() == [str(4 * HEIGHT), "4", "4"], done.stderr


@pytest.mark.skipif(not hasattr(os, "memfd_create"), reason="needs files in memory")
def test_nothing_is_written_to_the_temporary_folder(tmp_path):
    """A full one spoils nothing, and a kill leaves nothing there."""
    folder = write_scene(tmp_path / "town")
    write_packed(read_scene(folder), tmp_path / "town.npz")
    code = ("import sys, tempfile\ntempfile.tempdir = '/nowhere'\n"
            "from clsplat.io.photos.views import read_photo\n"
            "from clsplat.io.scenes.read import read_scene\n"
            "for path in sys.argv[1:]:\n    print(read_photo(read_scene(path).views[0]).mean())\n")
    done = subprocess.run([sys.executable, "-c", code, folder, tmp_path / "town.npz"],
                          capture_output=True, text=True, timeout=300, check=False)
    assert done.stdout == "90.0\n90.0\n", done.stderr


def test_a_full_temporary_folder_is_named(tmp_path, monkeypatch):
    """Where there are no files in memory, as on macOS."""
    folder = write_scene(tmp_path / "town")
    write_packed(read_scene(folder), tmp_path / "town.npz")
    monkeypatch.delattr(os, "memfd_create", raising=False)
    assert len(read_scene(tmp_path / "town.npz").views) == 4
    monkeypatch.setattr("tempfile.tempdir", "/dev/full")
    refused(tmp_path / "town.npz", "temporary folder /dev/full", "TMPDIR")


def far_away(**parts):
    """A frame of transforms.json whose photo or points are a trap."""
    def make(folder):
        scene = read_scene(write_scene(folder / "made"))
        table = layouts.write_transforms(folder, scene)
        layouts.write_json(folder / "transforms.json", {**table, **parts})
        return folder
    return make


TRANSFORMS = {
    "points are a device": (dict(ply_file_path="/dev/zero"), ("/dev/zero", "a device")),
    "points are a folder": (dict(ply_file_path="."), ("a folder",)),
    "points are missing": (dict(ply_file_path="gone.ply"), ("gone.ply", "no such file")),
    "points of a long name": (dict(ply_file_path="a" * 5000), ("too long",)),
    "no frames": (dict(frames=[]), ("no frames",)),
    "frames are text": (dict(frames="abc"), ("no frames",)),
    "a frame is a number": (dict(frames=[3]), ("frame 0",)),
    "a photo is a device": (dict(frames=[{"file_path": "/dev/zero", "transform_matrix": np.eye(
        4).tolist()}]), ("/dev/zero", "a device")),
    "a photo of a long name": (dict(frames=[{"file_path": "a/" * 3000 + "b.png",
                                             "transform_matrix": np.eye(4).tolist()}]),
                               ("a/a/",)),
    "width of text": (dict(w="wide", h=3), ("w is not a number",)),
    "width of 1e300": (dict(w=1e30, h=3), ("w is not a number of pixels",)),
}


@pytest.mark.parametrize("case", TRANSFORMS)
def test_transforms(tmp_path, case):
    parts, words = TRANSFORMS[case]
    refused(far_away(**parts)(tmp_path / "town"), *words)


def test_citygs_with_half_of_it(tmp_path):
    scene = read_scene(write_scene(tmp_path / "made"))
    layouts.write_citygs(tmp_path / "city", scene, {"photo_1.png", "photo_3.png"})
    shutil.rmtree(tmp_path / "city/val")
    refused(tmp_path / "city", "val", "missing")


def test_cameras_of_two_sizes_and_off_centre(tmp_path):
    made = reconstruction()
    second = pycolmap.Camera(model="PINHOLE", width=60, height=20, camera_id=99,
                             params=[40.0, 41.0, 3.5, 19.0])
    scene = read_scene(write_scene(tmp_path / "town", made))
    path = tmp_path / "town/sparse/0/cameras.bin"
    data = bytearray(path.read_bytes())
    struct.pack_into("<QQ4d", data, 16, second.width, second.height, *second.params)
    path.write_bytes(data)
    other = {view.name for view in scene.views}
    for name in other:
        if len(made.cameras) == 1:
            write_image(tmp_path / "town/images" / name, np.zeros((20, 60, 3), np.uint8))
    scene = read_scene(tmp_path / "town")
    assert (60, 20) in sizes(scene)
    assert any(view.camera.centre == (3.5, 19.0) for view in scene.views)
    assert all(np.isfinite(view.camera.project(scene.points)[0]).all() for view in scene.views)


@pytest.mark.parametrize("factor, shift", [(1e-6, 0.0), (1.0, 5e6), (1e9, 0.0)])
def test_units(tmp_path, factor, shift):
    """Tiny, far (UTM) and huge scenes are the same scene."""
    plain = read_scene(write_scene(tmp_path / "plain")).normalised()
    made = reconstruction()
    made.transform(pycolmap.Sim3d(factor, pycolmap.Rotation3d(), np.full(3, shift)))
    scene = read_scene(write_scene(tmp_path / "town", made)).normalised()
    assert np.allclose(scene.points, plain.points, atol=1e-6)
    assert scene.extent == pytest.approx(1)


def test_a_packed_scene_keeps_what_is_held_out(tmp_path):
    folder = tmp_path / "town"
    scene = read_scene(write_scene(folder))
    layouts.write_citygs(tmp_path / "city", scene, {"photo_1.png", "photo_3.png"})
    city = read_scene(tmp_path / "city")
    write_packed(city, tmp_path / "city.npz")
    assert read_scene(tmp_path / "city.npz").held_out == city.held_out != frozenset()
