"""Extreme scenes from file to image: far coordinates, few cameras, bad clouds."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from skimage.io import imsave

from clsplat.densify.sphere import with_spheres
from clsplat.gaussians import Gaussians, mean_inverse_distance
from clsplat.io.scenes.colmap_files import write_colmap
from clsplat.io.scenes.read import read_scene
from clsplat.rendering.pipeline import Renderer
from clsplat.scene import Scene, View
from tests import cases
from tests.checks import close
from tests.kernels.chain import camera_of, depth_order, upload_rows
from tests.reference.blend import blend
from tests.reference.project import project

UTM = np.array([448_262.3, 5_411_932.7, 312.9])
SIZE = 48, 40


def cloud(count=60, seed=0):
    """(points [N, 3] before a turned camera, colours uint8[N, 3], the camera as a dict)."""
    scene = cases.gaussians("quaternions", seed, count)
    colours = np.random.default_rng(seed).integers(0, 256, (count, 3)).astype(np.uint8)
    return scene["rows"]["positions"], colours, scene["camera"]


def as_scene(points, colours, *cameras):
    return Scene(
        "made", tuple(View(f"{i}.png", camera_of({"camera": c}), b"") for i, c in enumerate(cameras)), points, colours
    )


def rendered(device, gaussians, camera, near=0.01):
    renderer = Renderer(device, gaussians.sh_degree, near)
    frame = renderer.render(upload_rows(device, gaussians.rows), renderer.pack(camera), *SIZE, sh_degree=0)
    return frame.image.download()


def by_reference(rows, camera):
    splats = project(rows, camera, 0, 0.01)
    return blend(splats, depth_order(splats), *SIZE, np.zeros(3))[0]


@pytest.fixture(scope="module")
def utm(tmp_path_factory):
    """A COLMAP model 5000 km from its origin, read: the Scene, its points and cameras as made."""
    folder = tmp_path_factory.mktemp("utm")
    points, colours, seen_by = cloud()
    far = points + UTM
    # 5000 km away an error of 1e-8 in a rotation shows: no rounding to float32 here
    turn = Rotation.from_matrix(seen_by["rotation"]).as_matrix()
    cameras = [
        {**seen_by, "rotation": turn, "translation": seen_by["translation"] + [0.1 * i, 0, 0] - turn @ UTM}
        for i in range(2)
    ]
    (folder / "images").mkdir()
    for name in "01":
        imsave(folder / "images" / f"{name}.png", np.zeros((*SIZE[::-1], 3), np.uint8), check_contrast=False)
    views = as_scene(far, colours, *cameras).views
    observations = np.indices((len(far), 2)).reshape(2, -1).T
    write_colmap(folder / "sparse" / "0", views, far, colours, observations)
    return read_scene(folder), far, cameras


@pytest.mark.one_in(2)
def test_utm_coordinates_render_as_at_the_origin(float_device, utm):
    """In float32 a coordinate there is rounded to half a metre; the scene is ten wide."""
    scene, far, cameras = utm
    assert np.abs(scene.points).max() < 100
    np.testing.assert_allclose(scene.points + scene.offset, far, rtol=0, atol=1e-8)
    gaussians = Gaussians.from_points(scene.points, scene.colours, sh_degree=0)
    rows = {name: values.astype(np.float64) for name, values in gaussians.rows.items()}
    expected = by_reference({**rows, "positions": far}, cameras[0])
    assert expected.max() > 0.1
    image = rendered(float_device, gaussians, scene.views[0].camera)
    assert np.abs(image - expected).max() < 1e-4  # some hundred roundings


@pytest.mark.parametrize("count", [1, 3])
def test_one_camera_or_several_at_one_place(float_device, count):
    """The extent, which cameras give, falls back to the cloud: the near plane stays before it."""
    points, colours, seen_by = cloud()
    scene = as_scene(points, colours, *[seen_by] * count).recentred()
    camera = scene.views[0].camera
    depths = camera.project(scene.points)[1]
    assert 0 < scene.near_plane < depths.min() and 1 < scene.extent < 100
    gaussians = Gaussians.from_points(scene.points, scene.colours, sh_degree=0)
    expected = by_reference(
        {name: values.astype(np.float64) for name, values in gaussians.rows.items()},
        {**seen_by, "translation": camera.translation},
    )
    assert expected.max() > 0.1
    close(rendered(float_device, gaussians, camera), expected, "float", "one camera")


def on_a_line(points):
    return points[0] + np.linspace(0, 1, len(points))[:, None] * (points[1] - points[0])


CLOUDS = {
    "duplicates": lambda points: np.concatenate([points, points, points[:5]]),
    "on a line, duplicates": lambda points: np.repeat(on_a_line(points), 3, axis=0),
    "1e-9 wide": lambda points: points[0] + (points - points[0]) * 1e-9 / 5,
    "1e9 wide": lambda points: points * 1e9 / 5,
}


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("name", CLOUDS)
def test_gaussians_on_bad_clouds_have_a_size(float_device, name):
    """Scales and spheres are finite and neither vanish nor exceed the cloud."""
    points = CLOUDS[name](cloud()[0])
    width = np.linalg.norm(np.ptp(points, axis=0))
    camera = cases.camera(*SIZE)
    camera["translation"] = np.array([0, 0, 3 * width]) - points.mean(0)
    scene = as_scene(points, np.full(points.shape, 200, np.uint8), camera).recentred()
    gaussians = Gaussians.from_points(scene.points, scene.colours, sh_degree=0)
    scales = np.exp(gaussians.log_scales.astype(np.float64))
    assert (scales > 0.9e-7 * width).all() and (scales < 1.1 * width).all()
    assert np.isfinite(mean_inverse_distance(scene.points))
    neighbours = min(15, len(np.unique(gaussians.positions, axis=0)) - 1)
    spheres = with_spheres(gaussians, neighbours)
    assert (spheres.max_offsets > 0).all() and np.isfinite(spheres.max_offsets).all()
    image = rendered(float_device, gaussians, scene.views[0].camera, 0.01 * width)
    assert np.isfinite(image).all() and image.max() > 0.01
