"""Scene folders as they come: from other systems, half copied, made by hand or by an enemy.

Each case changes a healthy scene; it is then read right, or refused in one line that says what to
do. Everything here is read without a device.
"""

import os
import shutil
import unicodedata

import numpy as np
import pytest
from PIL import Image

from clsplat.io.photos.views import read_photo
from clsplat.io.scenes.read import read_scene
from tests import refusals
from tests.adversarial.test_photos import exif
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
    refusals.refused(lambda: read_scene(path, images), ";", *words)


NAMES = {
    "umlauts, text model": (lambda name: f"Straße {name}", True),
    "folders": (lambda name: f"drone  1/day-2/{name}", True),
    "quotes": (lambda name: f"it's \" $(x) %s {{}} {name}", True),
    "245 bytes": (lambda name: "n" * (245 - len(name)) + name, False),
}


@pytest.mark.parametrize("case", NAMES)
def test_names(tmp_path, case):
    change, text = NAMES[case]
    scene = read_scene(renamed(change, text)(tmp_path / "town"))
    assert [view.name for view in scene.views] == [change(f"photo_{i}.png") for i in range(4)]
    assert all(read_photo(view).shape == (HEIGHT, WIDTH, 3) for view in scene.views)


@pytest.mark.parametrize(
    "name, words",
    [
        ("n" * 247 + ".png", ("too long", "rename")),
        ("../photo.png", ("leaves the scene's image folder",)),
        ("a\\..\\..\\photo.png", ("leaves the scene's image folder",)),
        ("a\nb.png", ("not valid text",)),
    ],
)
def test_names_that_are_refused(tmp_path, name, words):
    folder = write_scene(tmp_path / "town")
    made = reconstruction()
    next(iter(made.images.values())).name = name
    made.write_binary(str(folder / "sparse" / "0"))
    refused(folder, *words)


PHOTO = "images/photo_1.png"
SCENES = {
    "other case": (lambda f: (f / PHOTO).rename(f / "images/Photo_1.PNG"), ("1 of 4", "letter case")),
    "decomposed on disk": (
        lambda f: (
            [renamed(lambda n: f"é{n}")(f)]
            + [
                path.rename(path.with_name(unicodedata.normalize("NFD", path.name)))
                for path in (f / "images").glob("é*")
            ]
        ),
        ("4 of 4", "form of its characters"),
    ),
    "other suffix": (lambda f: (f / PHOTO).rename(f / "images/photo_1.jpg"), ("1 of 4", "in its suffix")),
    "photo is a device": (lambda f: ((f / PHOTO).unlink(), (f / PHOTO).symlink_to("/dev/zero")), ("a device",)),
    "EXIF turned": (
        lambda f: Image.new("RGB", (HEIGHT, WIDTH)).save(f / PHOTO, exif=exif(6)),
        ("EXIF orientation 6", "-auto-orient"),
    ),
    "cameras is a pipe": (
        lambda f: [(f / f"sparse/0/{n}").unlink() for n in ("cameras.bin",)] + [os.mkfifo(f / "sparse/0/cameras.bin")],
        ("cameras.bin",),
    ),
    "only a Git LFS pointer": (
        lambda f: (f / "sparse/0/images.bin").write_text("version https://git-lfs.github.com/spec/v1\n"),
        ("images.bin", "copy the model again"),
    ),
    "half the model is text": (
        lambda f: (f / "sparse/0/images.bin").rename(f / "sparse/0/images.txt"),
        ("images.bin", "no such file"),
    ),
    "a photo missing in images_2": (
        lambda f: (shrunk(f, "images_2", 2, range(3)), shutil.rmtree(f / "images")),
        ("1 of 4",),
    ),
}


@pytest.mark.parametrize("case", SCENES)
def test_scenes_that_are_refused(tmp_path, case):
    spoil, words = SCENES[case]
    if os.name == "nt" and case in ("photo is a device", "cameras is a pipe"):
        pytest.skip("Windows has no such files")
    folder = write_scene(tmp_path / "town")
    spoil(folder)
    refused(folder, *words)


def test_smaller_photos_scale_the_cameras(tmp_path):
    name, factor = "images_3", 3
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
        (note,) = scene.notes
        assert f"{name}/" in note and "times smaller" in note
        assert read_photo(scene.views[2])[0, 0, 0] == 2
    refused(folder, "--images images_9", "images_8", images="images_9")


def test_a_folder_of_photos_elsewhere(tmp_path):
    folder = write_scene(tmp_path / "town")
    (folder / "images").rename(tmp_path / "photos")
    for images in ("../photos", str(tmp_path / "photos")):
        scene = read_scene(folder, images)
        assert sizes(scene) == {(WIDTH, HEIGHT)} and "photos/" in scene.notes[0]


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
    assert len(scene.views) == 4 and scene.notes == ()
    (folder / "sparse/1").rename(folder / "sparse/0")
    scene = read_scene(folder)
    assert len(scene.views) == 2 and "sparse/10 is larger" in scene.notes[0]


def test_notes_on_photos(tmp_path):
    folder = write_scene(tmp_path / "town")
    Image.new("RGBA", (WIDTH, HEIGHT)).save(folder / PHOTO)
    Image.new("RGB", (WIDTH, HEIGHT)).save(folder / "images/photo_2.png", exif=exif(3))
    alpha, turned = read_scene(folder).notes
    assert alpha.startswith("1 of 4 photos have an alpha channel: transparent pixels are")
    assert turned.startswith("1 of 4 photos have an EXIF orientation")
