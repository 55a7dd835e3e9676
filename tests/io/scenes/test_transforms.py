"""transforms.json of nerfstudio, instant-ngp and MatrixCity is read as it was written."""

import logging
from dataclasses import replace

import numpy as np
import pytest

from clsplat.camera import Camera
from clsplat.errors import InputError
from clsplat.io.photos.images import write_image
from clsplat.io.photos.views import read_photo, read_valid
from clsplat.io.scenes import transforms
from clsplat.io.scenes.posed import sample_points
from clsplat.io.scenes.read import read_scene
from clsplat.scene import View
from tests.data import layouts
from tests.refusals import refused

HELD_OUT = {"004.jpg", "016.jpg"}


def images(name):
    return f"images/{name}"


def changed(folder, table, **changes):
    """Write transforms.json with changed values; None removes a key."""
    table = {**table, **changes}
    layouts.write_json(folder / "transforms.json", {k: v for k, v in table.items() if v is not None})
    return folder


def test_nerfstudio(tmp_path, city):
    layouts.write_transforms(tmp_path, city)
    scene = read_scene(tmp_path)
    layouts.assert_same_cameras(scene, city, images)
    np.testing.assert_allclose(layouts.world_points(scene), layouts.world_points(city), atol=1e-9)
    assert np.array_equal(scene.colours, city.colours)
    assert scene.held_out is None and scene.observations is None
    assert scene.path == tmp_path and scene.name == tmp_path.name
    assert [v.source.name for v in scene.views] == [v.name for v in city.views]


def test_angle_of_view_and_names_without_suffix(tmp_path, city):
    table = layouts.write_transforms(tmp_path, city)
    frames = [{**frame, "file_path": "./" + frame["file_path"].removesuffix(".jpg")} for frame in table["frames"]]
    layouts.write_json(tmp_path / "transforms.json", {**layouts.camera_angle(city), "frames": frames})
    layouts.assert_same_cameras(read_scene(tmp_path), city, images)
    layouts.write_json(
        tmp_path / "transforms.json", {**layouts.camera_angle(city), "camera_angle_y": 1.2, "frames": frames}
    )
    focal = read_scene(tmp_path).views[0].camera.focal
    np.testing.assert_allclose(focal[1], 120 / np.tan(0.6))


def test_rounded_rotations_far_from_the_origin(tmp_path, city):
    """Six digits of a rotation, at UTM coordinates: cameras stay where the file says."""
    far = replace(city, offset=city.offset + (5e5, 5e6, 300))
    table = layouts.write_transforms(tmp_path, far)
    for frame in table["frames"]:
        matrix = np.array(frame["transform_matrix"])
        matrix[:3, :3] = matrix[:3, :3].round(6)
        frame["transform_matrix"] = matrix[:3].tolist()
    scene = read_scene(changed(tmp_path, table))
    for view, old in zip(scene.views, far.views):
        np.testing.assert_allclose(
            view.camera.position + scene.offset, old.camera.position + far.offset, rtol=0, atol=1e-8
        )
        assert np.abs(view.camera.rotation - old.camera.rotation).max() < 1e-6


def test_matrixcity_splits(tmp_path, city):
    scene = read_scene(layouts.write_splits(tmp_path, city, HELD_OUT))

    def name(old):
        return f"test/block_1_test/{old}" if old in HELD_OUT else f"train/block_1/{old}"

    layouts.assert_same_cameras(scene, city, name)
    assert scene.held_out == {name(old) for old in HELD_OUT}
    train, test = scene.split(8)
    assert {view.name for view in test} == scene.held_out and len(train) == 6


def test_points_of_a_colmap_model_that_nerfstudio_rotated(tmp_path, city):
    table = layouts.write_transforms(tmp_path, city)
    (tmp_path / "sparse_pc.ply").unlink()
    some = np.arange(0, 400)
    layouts.write_model(tmp_path / "colmap/sparse/0", city, city.views, some)
    scene = read_scene(changed(tmp_path, table, ply_file_path=None))
    np.testing.assert_allclose(layouts.world_points(scene), layouts.world_points(city)[some], atol=1e-9)
    assert np.array_equal(scene.colours, city.colours[some])
    turn = [[1, 0, 0, 5], [0, 0, 1, 0], [0, -1, 0, 0]]
    scene = read_scene(changed(tmp_path, table, ply_file_path=None, applied_transform=turn, applied_scale=2.0))
    x, y, z = layouts.world_points(city)[some].T
    np.testing.assert_allclose(layouts.world_points(scene), 2 * np.stack([x + 5, z, -y], axis=1), atol=1e-9)


def test_points_are_sampled_where_two_cameras_look(tmp_path, city, caplog):
    table = layouts.write_transforms(tmp_path, city)
    (tmp_path / "sparse_pc.ply").unlink()
    with caplog.at_level(logging.WARNING):
        scene = read_scene(changed(tmp_path, table, ply_file_path=None))
    assert "no sparse points: 4000 are sampled" in caplog.text
    layouts.assert_same_cameras(scene, city, images)
    sees = np.zeros(len(scene.points), int)
    for view in scene.views:
        pixels, depths = view.camera.project(scene.points)
        sees += (depths > 0) & ((pixels >= 0) & (pixels <= (320, 240))).all(axis=1)
    assert len(scene.points) == 4000 and sees.min() >= 2
    assert np.array_equal(scene.points, read_scene(tmp_path).points)


def looking(positions, side=1):
    """Views at those positions, looking along x, left or right."""
    rotation = np.array([(0, -side, 0), (0, 0, -1), (side, 0, 0)], float)
    return [
        View(str(i), Camera(64, 48, (50.0, 50.0), (32.0, 24.0), rotation, -rotation @ np.array(p, float)), b"")
        for i, p in enumerate(positions)
    ]


def test_sampled_points_follow_the_unit_and_need_two_places():
    views = looking([(0, 0, 0), (0, 1, 0), (0, 2, 0)])
    points = sample_points("a", views)
    assert len(points) == 1500
    pixels, depths = views[1].camera.project(points)
    inside = pixels[((pixels > 0) & (pixels < (64, 48))).all(axis=1)]
    assert (inside.min(axis=0) < (6, 5)).all() and (inside.max(axis=0) > (58, 43)).all()
    assert 0.7 < depths.min() < 2 and 10 < depths.max() < 17  # 0.5 to 8 times 1 or 2
    large = sample_points("a", looking([(0, 0, 0), (0, 1e3, 0), (0, 2e3, 0)]))
    np.testing.assert_allclose(large, 1e3 * points, rtol=1e-9)
    for blind in (looking([(0, 0, 0)]), looking([(0, 0, 0)] * 3), looking([(9, 0, 0)]) + looking([(-9, 0, 0)], -1)):
        with pytest.raises(InputError, match="a: no points, and no two cameras.*points3D.ply"):
            sample_points("a", blind)


def first(**changes):
    """The frames, the first one changed."""
    return lambda table: {"frames": [{**table["frames"][0], **changes}, *table["frames"][1:]]}


@pytest.mark.parametrize(
    "change, model, views",
    [
        ({"k1": -0.1, "p2": 0.01}, "OPENCV", 1),
        ({"camera_model": "OPENCV", "k1": -0.1, "k3": 0.01}, "FULL_OPENCV", 1),
        ({"camera_model": "OPENCV_FISHEYE", "k1": 0.1}, "OPENCV_FISHEYE", 1),
        ({"is_fisheye": True}, "OPENCV_FISHEYE", 1),
        ({"camera_model": "EQUIRECTANGULAR"}, "EQUIRECTANGULAR", 6),
        ({"camera_model": "SIMPLE_RADIAL", "k1": 0}, None, 1),
    ],
)
def test_lenses(tmp_path, city, change, model, views):
    table = layouts.write_transforms(tmp_path, city)
    scene = read_scene(changed(tmp_path, table, **change))
    assert len(scene.views) == views * len(city.views)
    lens = scene.views[0].lens
    assert (lens and lens.model) == model
    assert read_photo(scene.views[0]).shape[:2] == (scene.views[0].camera.height, scene.views[0].camera.width)


def test_masks_that_frames_name(tmp_path, city):
    table = layouts.write_transforms(tmp_path, city)
    changed(tmp_path, table, **first(mask_path="stencils/a.png")(table))
    (tmp_path / "stencils").mkdir()
    camera = city.views[0].camera
    valid = np.zeros((camera.height, camera.width, 3))
    valid[5:] = 1
    write_image(tmp_path / "stencils/a.png", valid)
    scene = read_scene(tmp_path)
    assert [view.mask is None for view in scene.views].count(False) == 1
    assert np.array_equal(read_valid(scene.views[0]), valid[..., 0] == 1)


def posed(change):
    """The frames, the pose of the first one changed."""
    return lambda table: first(transform_matrix=change(np.array(table["frames"][0]["transform_matrix"])).tolist())(
        table
    )


@pytest.mark.parametrize(
    "change, words",
    [
        ({"k1": 1e9}, "camera of image images/000.jpg cannot be undistorted"),
        ({"camera_model": "SPIRAL"}, "frame 0.*camera_model is 'SPIRAL', not OPENCV_FISHEYE"),
        ({"frames": []}, "no frames.*copy it again"),
        ({"fl_x": None}, "frame 0.*neither fl_x nor camera_angle_x"),
        ({"fl_x": None, "camera_angle_x": 4.0}, "camera_angle_x is not an angle of view"),
        ({"fl_x": "270"}, "fl_x is not a number"),
        ({"fl_x": -3.0}, "no focal length"),
        ({"w": 320.5}, "w is not a number of pixels"),
        ({"ply_file_path": "none.ply"}, "none.ply.*no such file"),
        ({"ply_file_path": "/dev/zero"}, "/dev/zero.*a device"),
        ({"applied_transform": [[1, 2]]}, "applied_transform is not a 3x4 or 4x4 matrix"),
        (first(file_path=None), "frame 0.*file_path is not valid text"),
        ({"fl_x": 10**400}, "10000000000000000000 is not a finite number"),
        (first(file_path="images/lost.jpg"), "lost.jpg: no such image"),
        (first(file_path="images/004.jpg"), "004.jpg occurs twice"),
        (first(transform_matrix=[["a"] * 4] * 4), "frame 0: "),
        (posed(lambda m: m * (1.2, 1.2, 1.2, 1)), "000.jpg is not a rotation"),
        (posed(np.transpose), "frame 0: .*is it transposed"),
        (posed(lambda m: 2 * m), "not 0 0 0 1"),
        (posed(lambda m: m[:2]), "3x4 or 4x4"),
    ],
)
def test_unusable_scenes(tmp_path, city, change, words):
    table = layouts.write_transforms(tmp_path, city)
    changed(tmp_path, table, **(change(table) if callable(change) else change))
    refused(lambda: read_scene(tmp_path), *words.split(".*"))


@pytest.mark.parametrize(
    "text, words",
    [
        ("{", "transforms.json: not a transforms.json, damaged or"),
        ('{"frames": [1, NaN]}', "NaN is not a finite number"),
        ('{"frames": [3]}', "frame 0: "),
    ],
)
def test_damaged_files(tmp_path, text, words):
    (tmp_path / "transforms.json").write_text(text)
    refused(lambda: read_scene(tmp_path), *words.split(".*"))


@pytest.mark.parametrize(
    "table, frame, focal",
    [
        ({"fl_x": 1, "fl_y": 2}, {"camera_angle_x": 1.0}, (146.44, 146.44)),
        ({"fl_x": 1, "fl_y": 2}, {"fl_y": 60}, (1, 60)),
        ({"fl_y": 60}, {"fl_x": 80}, (80, 60)),
        ({"camera_angle_x": 0.1, "fl_y": 5}, {"fl_x": 80, "fl_y": 60}, (80, 60)),
        ({"fl_x": 80, "fl_y": 60}, {}, (80, 60)),
    ],
)
def test_the_focal_length_of_a_frame_beats_that_of_the_table(table, frame, focal):
    own = transforms._own(table, frame)
    assert (
        transforms._focal(own, *transforms.FOCAL_X, 160),
        transforms._focal(own, *transforms.FOCAL_Y, 120, transforms._focal(own, *transforms.FOCAL_X, 160)),
    ) == pytest.approx(focal, abs=0.01)


@pytest.mark.parametrize(
    "table, frame, model",
    [
        ({"k1": 0.1}, {}, "OPENCV"),
        ({"k1": 0.1}, {"k1": 0}, None),
        ({}, {"k1": 0.1}, "OPENCV"),
        ({"k4": -0.1}, {}, "its coefficient k4"),
        ({"k4": -0.1, "camera_model": "FULL_OPENCV"}, {}, "FULL_OPENCV"),
        ({"k4": -0.1, "is_fisheye": True}, {}, "OPENCV_FISHEYE"),
        ({"k4": -0.1, "is_fisheye": True}, {"camera_model": "OPENCV"}, None),
        ({"camera_model": "OPENCV_FISHEYE"}, {"camera_model": "PINHOLE"}, None),
        ({"camera_model": "PINHOLE"}, {"is_fisheye": True}, "OPENCV_FISHEYE"),
        ({"k5": 0.1}, {}, "its coefficient k5"),
        ({"k6": 0.1}, {"is_fisheye": True}, None),
        ({"is_fisheye": True, "k5": 0.1}, {}, "its coefficient k5"),
        ({"is_fisheye": True}, {"p1": 0.1}, "its coefficient p1"),
        ({"k6": 0.1, "camera_model": "FULL_OPENCV"}, {}, "FULL_OPENCV"),
        ({"ftheta_p0": 0.1}, {}, "F-theta"),
        ({"k1": "a"}, {}, "k1 is not a number"),
    ],
)
def test_each_coefficient_is_used_or_refused(table, frame, model):
    own = transforms._own(table, frame)
    if frame == {"is_fisheye": True}:
        model = "OPENCV_FISHEYE"
    camera = own, (160, 120), (100.0, 100.0), (80.0, 60.0)
    if model and " " in model or model == "F-theta":
        with pytest.raises(ValueError, match=model):
            transforms._optics(*camera)
        return
    lens = transforms._optics(*camera).model
    assert (lens and lens[0]) == model
