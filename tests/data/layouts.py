"""A scene written in the layouts of large data sets, so that reading it back can be compared."""

import json
import math
import shutil
from dataclasses import replace

import numpy as np
import plyfile

from clsplat.io.scenes.colmap_files import write_colmap

OPENGL = np.array([1.0, -1.0, -1.0])  # camera axes right, down, forward to right, up, back
# world axes of Mega-NeRF: right, down, forward to down, right, back
DRB = np.array([(0.0, 1.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, -1.0)])


def every_fourth(scene):
    """The scene with every fourth view: enough to compare, and quickly read."""
    seen = scene.observations[scene.observations[:, 1] % 4 == 0]
    return replace(scene, views=scene.views[::4], observations=seen // (1, 4))


def world_points(scene):
    return scene.points + scene.offset


def pose(scene, view):
    """float64[4, 4], camera to world, OpenGL axes, original coordinates."""
    matrix = np.eye(4)
    matrix[:3, :3] = view.camera.rotation.T * OPENGL
    matrix[:3, 3] = view.camera.position + scene.offset
    return matrix


def intrinsics(camera):
    return {
        "w": camera.width,
        "h": camera.height,
        "fl_x": camera.focal[0],
        "fl_y": camera.focal[1],
        "cx": camera.centre[0],
        "cy": camera.centre[1],
    }


def put_photo(view, path):
    path.parent.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(view.source, path)


def write_json(path, table):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(table))


def write_ply(path, points, colours=None):
    kinds = [(name, "f8") for name in "xyz"]
    kinds += [(name, "u1") for name in ("red", "green", "blue")] if colours is not None else []
    rows = np.empty(len(points), kinds)
    for axis, name in enumerate("xyz"):
        rows[name] = points[:, axis]
    for axis, name in enumerate(rows.dtype.names[3:]):
        rows[name] = colours[:, axis]
    plyfile.PlyData([plyfile.PlyElement.describe(rows, "vertex")]).write(str(path))


def write_transforms(folder, scene, photos="images"):
    """nerfstudio's transforms.json, one camera for all, and sparse_pc.ply."""
    for view in scene.views:
        put_photo(view, folder / photos / view.name)
    write_ply(folder / "sparse_pc.ply", world_points(scene), scene.colours)
    table = {
        "camera_model": "OPENCV",
        **intrinsics(scene.views[0].camera),
        "k1": 0.0,
        "p2": 0,
        "aabb_scale": 16,
        "ply_file_path": "sparse_pc.ply",
        "frames": [
            {"file_path": f"{photos}/{view.name}", "transform_matrix": pose(scene, view).tolist()}
            for view in scene.views
        ],
    }
    write_json(folder / "transforms.json", table)
    return table


def camera_angle(scene):
    camera = scene.views[0].camera
    return {"camera_angle_x": 2 * math.atan(camera.width / 2 / camera.focal[0])}


def write_splits(folder, scene, held_out):
    """MatrixCity's tree, photos in aerial/train/block_1 and aerial/test/block_1_test; returns the
    folder of the split, aerial/pose/block_A."""
    split = folder / "aerial" / "pose" / "block_A"
    for part, block in (("train", "block_1"), ("test", "block_1_test")):
        frames = []
        for view in scene.views:
            if (view.name in held_out) == (part == "test"):
                put_photo(view, folder / "aerial" / part / block / view.name)
                frames.append(
                    {"file_path": f"../../{part}/{block}/{view.name}", "transform_matrix": pose(scene, view).tolist()}
                )
        write_json(
            split / f"transforms_{part}.json",
            {**camera_angle(scene), **intrinsics(scene.views[0].camera), "frames": frames},
        )
    write_ply(split / "points3D.ply", world_points(scene), scene.colours)
    return split


def write_mega_nerf(folder, scene, held_out, save, scale=50.0, dtype=np.float64):
    """Mega-NeRF's tree, without points; save: called with a table and a path, as torch.save;
    numbers in `dtype`."""
    poses = {view.name: pose(scene, view)[:3] for view in scene.views}
    origin = DRB @ np.mean([matrix[:, 3] for matrix in poses.values()], axis=0)
    folder.mkdir(parents=True, exist_ok=True)
    save({"origin_drb": origin.astype(dtype), "pose_scale_factor": scale}, folder / "coordinates.pt")
    for number, view in enumerate(scene.views):
        part, camera = "val" if view.name in held_out else "train", view.camera
        matrix = DRB @ poses[view.name]
        matrix[:, 3] = (matrix[:, 3] - origin) / scale
        put_photo(view, folder / part / "rgbs" / f"{number:06d}{view.source.suffix}")
        metadata = folder / part / "metadata" / f"{number:06d}.pt"
        metadata.parent.mkdir(parents=True, exist_ok=True)
        save(
            {
                "H": camera.height,
                "W": camera.width,
                "c2w": matrix.astype(dtype),
                "intrinsics": np.array([*camera.focal, *camera.centre], dtype),
                "distortion": np.array([0.01, 0, 0, 0], dtype),
            },
            metadata,
        )


def write_model(folder, scene, views, points):
    """A COLMAP model in original coordinates of some views, and of the points they see."""
    names = [view.name for view in scene.views]
    place = {names.index(view.name): number for number, view in enumerate(views)}
    seen = scene.observations
    seen = seen[np.isin(seen[:, 0], points) & np.isin(seen[:, 1], list(place))]
    view = np.array([place[number] for number in seen[:, 1]])
    moved = [replace(view, camera=view.camera.shifted(-scene.offset)) for view in views]
    write_colmap(
        folder,
        moved,
        world_points(scene)[points],
        scene.colours[points],
        np.column_stack([np.searchsorted(points, seen[:, 0]), view]),
    )


def write_citygs(folder, scene, held_out, photos="images"):
    for part in ("train", "val"):
        views = [view for view in scene.views if (view.name in held_out) == (part == "val")]
        for view in views:
            put_photo(view, folder / part / photos / view.name)
        write_model(folder / part / "sparse" / "0", scene, views, np.arange(len(scene.points)))


def assert_same_cameras(read, scene, name_of=str):
    """Every view of `scene` was read: its camera in original coordinates, its lens and its photo;
    name_of: name of a view -> name it was read by."""
    views = {view.name: view for view in read.views}
    assert sorted(views) == sorted(name_of(view.name) for view in scene.views)
    for view in scene.views:
        found, wanted = views[name_of(view.name)], view.camera
        own = found.camera
        assert (own.width, own.height) == (wanted.width, wanted.height)
        np.testing.assert_allclose((*own.focal, *own.centre), (*wanted.focal, *wanted.centre), atol=1e-9)
        np.testing.assert_allclose(own.rotation, wanted.rotation, atol=1e-9)
        np.testing.assert_allclose(own.position + read.offset, wanted.position + scene.offset, rtol=1e-9, atol=1e-9)
        assert (found.lens is None) == (view.lens is None)
        if view.lens is not None:
            assert (found.lens.size, found.lens.model) == (view.lens.size, view.lens.model)
            np.testing.assert_allclose(found.lens.parameters, view.lens.parameters, atol=1e-9)
        assert found.source.read_bytes() == view.source.read_bytes()


def assert_same(read, scene, points=1e-9):
    """Two scenes have the same views and points, in original coordinates."""
    assert_same_cameras(read, scene)
    np.testing.assert_allclose(world_points(read), world_points(scene), atol=points)
    assert np.array_equal(read.colours, scene.colours)
