"""COLMAP models are read as pycolmap reads them, and messages name the damaged file."""

import struct

import numpy as np
import pycolmap
import pytest

from clsplat.camera import Camera
from clsplat.io.photos.images import write_image
from clsplat.io.scenes import colmap_files
from clsplat.io.scenes.colmap import read_colmap
from clsplat.io.scenes.colmap_files import CAMERA_MODELS
from clsplat.io.scenes.read import fingerprint, read_scene
from clsplat.scene import View
from tests import refusals
from tests.data.tiny_model import CENTRE, FOCAL, HEIGHT, WIDTH, reconstruction, write_scene


def refused(path, *words):
    refusals.refused(lambda: read_scene(path), *words)


@pytest.mark.parametrize("text", [False, True])
@pytest.mark.parametrize("model", ["sparse/0", "sparse", "."])
def test_reads_what_pycolmap_wrote(tmp_path, text, model):
    made = reconstruction()
    scene = read_colmap(write_scene(tmp_path / "town", made, text, model))
    assert scene.name == "town"
    assert [view.name for view in scene.views] == [f"photo_{i}.png" for i in range(4)]
    assert np.allclose(np.median(scene.points, axis=0), 0, atol=1e-12)
    points = np.array([p.xyz for _, p in sorted(made.points3D.items())])
    assert np.allclose(scene.points + scene.offset, points)
    colours = np.array([p.color for _, p in sorted(made.points3D.items())])
    assert scene.colours.dtype == np.uint8 and np.array_equal(scene.colours, colours)
    for view in scene.views:
        image = next(i for i in made.images.values() if i.name == view.name)
        assert view.source == tmp_path / "town" / "images" / view.name
        assert (view.camera.width, view.camera.height) == (WIDTH, HEIGHT)
        assert view.camera.focal == FOCAL and view.camera.centre == CENTRE
        pixels, _ = view.camera.project(scene.points)
        expected = np.array([image.project_point(p) for p in points])
        assert np.allclose(pixels, expected, atol=1e-6)


def tracks(made):
    """{(point, view)} of a reconstruction: points by number, views by name."""
    names = sorted(image.name for image in made.images.values())
    points = {number: place for place, number in enumerate(sorted(made.points3D))}
    return {
        (points[seen.point3D_id], names.index(image.name))
        for image in made.images.values()
        for seen in image.points2D
        if seen.has_point3D()
    }


@pytest.mark.parametrize("text", [False, True])
def test_observations_are_the_tracks(tmp_path, text):
    made = reconstruction()
    images = {image.name: number for number, image in made.images.items()}
    first, *_, last = sorted(made.points3D)
    for element in made.points3D[first].track.elements[:2]:
        made.delete_observation(element.image_id, element.point2D_idx)
    made.delete_point3D(last - 3)
    photo = made.images[images["photo_2.png"]]
    again = max(place for place, seen in enumerate(photo.points2D) if seen.point3D_id == last)
    loose = next(place for place, seen in enumerate(photo.points2D) if not seen.has_point3D())
    assert again != loose
    made.add_observation(last, pycolmap.TrackElement(photo.image_id, loose))  # seen there twice
    scene = read_colmap(write_scene(tmp_path / "town", made, text))
    expected = np.array(sorted(tracks(made)))
    assert len(expected) == 30 * 4 - 2 - 4
    assert scene.observations.dtype == np.int32
    assert np.array_equal(scene.observations, expected)
    assert scene.reduced(2).recentred().observations is scene.observations


@pytest.mark.parametrize("at_once", [1, 3, 1 << 16])
def test_points_of_any_order_are_written_with_their_tracks(tmp_path, monkeypatch, at_once):
    rng = np.random.default_rng(0)
    views = [
        View(f"{number}.jpg", Camera(9, 9, (9.0, 9.0), (4.5, 4.5), np.eye(3), np.zeros(3)), tmp_path)
        for number in range(4)
    ]
    seen = rng.permutation(np.argwhere(rng.random((7, 4)) < 0.4))
    assert len(np.unique(seen[:, 0])) < 7  # some are not seen
    points, colours = rng.normal(size=(7, 3)), rng.integers(0, 256, (7, 3)).astype(np.uint8)
    monkeypatch.setattr(colmap_files, "POINTS_AT_ONCE", at_once)
    colmap_files.write_colmap(tmp_path, views, points, colours, seen, rng.random((len(seen), 2)))
    read = colmap_files.read_part(tmp_path / "points3D.bin", "points3D")
    assert (read.positions == points).all() and (read.colours == colours).all()
    assert {*zip(read.rows.tolist(), (read.images - 1).tolist())} == set(map(tuple, seen.tolist()))


def test_fingerprint_tells_scenes_apart(tmp_path):
    made = reconstruction()
    write_scene(tmp_path / "a", made)
    write_scene(tmp_path / "b", made)
    same = fingerprint(read_scene(tmp_path / "a"))
    assert len(same) == 64 and fingerprint(read_scene(tmp_path / "b")) == same
    point = next(iter(made.points3D.values()))
    point.xyz = point.xyz + 1e-9
    assert fingerprint(read_scene(write_scene(tmp_path / "b", made))) != same


@pytest.mark.parametrize("part", ["cameras", "images", "points3D"])
@pytest.mark.parametrize("share", [0, 0.5, 1])
def test_a_truncated_file_is_named(tmp_path, part, share):
    path = write_scene(tmp_path) / "sparse" / "0" / f"{part}.bin"
    data = path.read_bytes()
    path.write_bytes(data[: min(int(share * len(data)), len(data) - 1)])
    refused(tmp_path, f"{part}.bin", "cut short")


@pytest.mark.parametrize("part", ["cameras", "images", "points3D"])
def test_a_missing_or_empty_file_is_named(tmp_path, part):
    for kind in ("bin", "txt"):
        folder = write_scene(tmp_path / kind, text=kind == "txt")
        path = folder / "sparse" / "0" / f"{part}.{kind}"
        path.write_bytes(bytes(8) if kind == "bin" else b"# only a comment\n\n")
        refused(folder, path.name, f"holds no {part}")
        path.unlink()
        refused(folder, path.name)


def put(path, offset, layout, *values):
    data = bytearray(path.read_bytes())
    struct.pack_into(layout, data, offset, *values)
    path.write_bytes(data)


@pytest.mark.parametrize(
    "part, offset, layout, values, words",
    [
        ("cameras", 0, "<Q", [2**60], ["cut short"]),
        ("cameras", 12, "<i", [99], ["camera 1", "model", "(99)"]),
        ("cameras", 16, "<Q", [0], ["no size"]),
        ("cameras", 16, "<Q", [2**63], ["2147483648x36"]),
        ("images", 8 + 60, "<I", [77], ["has camera 77", "not in the model"]),
        ("images", 8 + 64, "<B", [255], ["utf-8"]),
        ("images", 8 + 4, "<4d", [0, 0, 0, 0], ["pose", "not finite"]),
        ("images", 8 + 36, "<d", [np.nan], ["the pose of image photo_", "1 of 4 images"]),
        ("images", 8 + 64 + 12, "<Q", [2**62], ["cut short"]),
        ("points3D", 8 + 43, "<Q", [2**64 - 1], ["cut short"]),
    ],
)
def test_a_damaged_record_is_named(tmp_path, part, offset, layout, values, words):
    path = write_scene(tmp_path) / "sparse" / "0" / f"{part}.bin"
    put(path, offset, layout, *values)
    refused(tmp_path, *words)


def test_duplicate_ids(tmp_path):
    folder = write_scene(tmp_path / "town") / "sparse" / "0"
    whole = {part: (folder / f"{part}.bin").read_bytes() for part in ("images", "points3D")}
    (first,) = struct.unpack_from("<I", whole["images"], 8)
    second = whole["images"].index(b"\0", 72) + 1
    second += 8 + 24 * struct.unpack_from("<Q", whole["images"], second)[0]
    put(folder / "images.bin", second, "<I", first)
    refused(tmp_path / "town", f"images holds id {first} twice")
    (folder / "images.bin").write_bytes(whole["images"])
    (first,) = struct.unpack_from("<Q", whole["points3D"], 8)
    put(folder / "points3D.bin", 8 + 51 + 8 * 4, "<Q", first)
    refused(tmp_path / "town", f"points3D holds id {first} twice")


@pytest.mark.parametrize(
    "part, old, new, words",
    [
        ("cameras", b" PINHOLE ", b" PINHOL ", ["'PINHOL'", "not a camera model"]),
        ("cameras", b" 48 36 ", b" 48 ", ["not a camera model"]),
        ("cameras", b" 48 36 ", b" 48 x ", ["line", "'x'"]),
        ("images", b" photo_0.png", b"", ["an image has 9 fields"]),
        ("points3D", b" 254 ", b" 256 ", ["range(0, 256)"]),
        ("points3D", b" ", b" nan ", ["line"]),
        ("points3D", b"0", b"\0", ["not a text file"]),
    ],
)
def test_a_damaged_line_is_named(tmp_path, part, old, new, words):
    path = write_scene(tmp_path, text=True) / "sparse" / "0" / f"{part}.txt"
    lines = path.read_bytes().splitlines(keepends=True)
    at = next(i for i, line in enumerate(lines) if not line.startswith(b"#") and old in line)
    lines[at] = lines[at].replace(old, new, 1)
    path.write_bytes(b"".join(lines))
    refused(tmp_path, f"{part}.txt", *words)


def test_unit_quaternions_keep_their_digits_and_others_are_scaled(tmp_path):
    folder = write_scene(tmp_path)
    path = folder / "sparse" / "0" / "images.bin"
    before = read_colmap(folder).views
    images = pycolmap.Reconstruction(str(path.parent)).images.values()
    for view in before:
        image = next(image for image in images if image.name == view.name)
        assert np.array_equal(view.camera.rotation, image.cam_from_world().matrix()[:, :3])
    quaternion = struct.unpack_from("<4d", path.read_bytes(), 12)
    put(path, 12, "<4d", *(3.0 * value for value in quaternion))
    for view, other in zip(read_colmap(folder).views, before):
        assert np.allclose(view.camera.rotation, other.camera.rotation, atol=1e-15)


def test_every_camera_model_of_pycolmap_is_known():
    create = getattr(pycolmap.Camera, "create_from_model_id", None) or pycolmap.Camera.create
    for name, number in pycolmap.CameraModelId.__members__.items():
        if int(number.value) >= 0:
            made = create(0, number, 50.0, 40, 30)
            assert list(CAMERA_MODELS)[number.value] == name
            assert CAMERA_MODELS[name] == len(made.params)


def test_photos(tmp_path):
    folder = write_scene(tmp_path)
    photo = folder / "images" / "photo_1.png"
    for width, height in ((24, 18), (36, 48), (48, 30)):
        write_image(photo, np.zeros((height, width, 3), np.uint8))
        refused(folder, "photo_1.png", "--images", f"{width}x{height}", "48x36", "put back")
    photo.write_bytes(b"")
    refused(folder, "photo_1.png", "not an image")
    for number in (1, 3):
        (folder / "images" / f"photo_{number}.png").unlink()
    refused(folder, "photo_1.png", "2 of 4 images")


def test_no_model(tmp_path):
    refused(tmp_path, str(tmp_path), "no COLMAP model", "docs/guide/photos.md")
    refused(tmp_path / "nowhere", "nowhere", "no such scene")
    (tmp_path / "town.zip").write_bytes(b"")
    refused(tmp_path / "town.zip", "town.zip", "not a scene")


TWO_LINES = "each image has two lines, of which the second may be empty"


@pytest.mark.parametrize(
    "change, expected",
    [
        (lambda lines: [line if number % 2 == 0 else "" for number, line in enumerate(lines)], ""),
        (lambda lines: lines[::2], TWO_LINES),
        (lambda lines: lines[:1] + lines[2:], TWO_LINES),
        (lambda lines: ["\ufeff" + lines[0], *lines[1:]], ""),
        (lambda lines: [line.replace(" ", "\t") + "  \r" for line in lines], ""),
        (lambda lines: [*lines, "", "", ""], ""),
        (lambda lines: [lines[0].replace(" ", " x", 1), *lines[1:]], "line 1"),
    ],
    ids=["no observations", "no lines of them", "a line lost", "byte order mark", "blanks", "empty lines", "a word"],
)
def test_text_of_other_programs_is_read_or_refused_with_the_cure(tmp_path, change, expected):
    folder = write_scene(tmp_path / "town", text=True)
    whole = read_scene(folder)
    path = folder / "sparse/0/images.txt"
    lines = [line for line in path.read_text().splitlines() if not line.startswith("#")]
    path.write_bytes("\n".join([*change(lines), ""]).encode())
    if expected:
        refused(folder, expected)
        return
    read = read_scene(folder)
    assert [view.name for view in read.views] == [view.name for view in whole.views]
    assert np.array_equal(read.points, whole.points)
