"""Every camera model of COLMAP becomes pinhole cameras that see the same."""

import numpy as np
import pycolmap
import pytest

from clsplat.camera import Camera
from clsplat.errors import InputError
from clsplat.io.photos.images import write_image
from clsplat.io.photos.lenses import FACES, undistorted_model
from clsplat.io.photos.views import read_photo, read_valid
from clsplat.io.scenes.colmap_files import CAMERA_MODELS, PINHOLES
from clsplat.scene import View

SIZE = 160, 120
# parameters after focal length and centre
DISTORTION = {
    "SIMPLE_RADIAL": (-0.1,),
    "RADIAL": (0.1, -0.02),
    "OPENCV": (-0.05, 0.02, 0.002, -0.003),
    "OPENCV_FISHEYE": (0.02, -0.01, 0, 0),
    "FULL_OPENCV": (-0.1, 0.02, 0.001, 0, 0.01, 0, 0, 0),
    "FOV": (0.8,),
    "SIMPLE_RADIAL_FISHEYE": (0.02,),
    "RADIAL_FISHEYE": (0.02, -0.01),
    "THIN_PRISM_FISHEYE": (0.02, 0, 0.001, 0.001, 0, 0, 0.001, 0.001),
    "RAD_TAN_THIN_PRISM_FISHEYE": (0.02, *[0.001] * 11),
    "SIMPLE_DIVISION": (-0.1,),
    "DIVISION": (-0.1,),
    "SIMPLE_FISHEYE": (),
    "FISHEYE": (),
    "EUCM": (0.6, 1.1),
}
PANORAMA = "EQUIRECTANGULAR"


def parameters(model, focal=130.0):
    """Of a camera of SIZE; a panorama of 4 x 2 right angles has no others."""
    if model == PANORAMA:
        return tuple(map(float, SIZE))
    count = CAMERA_MODELS[model] - len(DISTORTION[model]) - 2
    return (*[focal] * count, SIZE[0] / 2 + 3, SIZE[1] / 2 - 2, *DISTORTION[model])


def colours(rays):
    """Smooth colours float64[..., 3], 0 to 1, of directions [..., 3]."""
    unit = rays / np.linalg.norm(rays, axis=-1, keepdims=True)
    return 0.5 + 0.4 * np.sin(3 * unit + [0.3, 1, 2])


def arrays_of(names, size=SIZE):
    """A model of photos at the origin, without focal lengths."""
    count = len(names)
    return {
        "names": np.array(names),
        "rotations": np.tile(np.eye(3), (count, 1, 1)),
        "translations": np.zeros((count, 3)),
        "focals": np.zeros((count, 2)),
        "centres": np.zeros((count, 2)),
        "sizes": np.tile(size, (count, 1)),
    }


def photo_of(path, model, values, size=SIZE):
    """Write the photo that a camera takes of `colours`; returns its path."""
    x, y = np.meshgrid(np.arange(size[0]) + 0.5, np.arange(size[1]) + 0.5)
    camera = pycolmap.Camera(model=model, width=size[0], height=size[1], params=list(values))
    rays = np.array(camera.cam_ray_from_img(np.stack([x.ravel(), y.ravel()], axis=1)))
    write_image(path, np.nan_to_num(colours(rays)).reshape(*x.shape, 3))
    return path


def views_of(arrays, source):
    """The views of undistorted arrays whose photos all have one source."""
    return [
        View(str(name), Camera(*map(int, size), tuple(focal), tuple(centre), turn, move), source, lens)
        for name, size, focal, centre, turn, move, lens in zip(
            *(arrays[key] for key in ("names", "sizes", "focals", "centres", "rotations", "translations", "lenses"))
        )
    ]


def check_colours(view, share=1.0):
    """Whether the undistorted photo shows what the view's pinhole camera sees, in a share of its
    pixels; returns how many count."""
    found, valid = read_photo(view), read_valid(view)
    camera = view.camera
    assert found.shape == (camera.height, camera.width, 3)
    x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
    rays = np.stack(
        [(x - camera.centre[0]) / camera.focal[0], (y - camera.centre[1]) / camera.focal[1], np.ones_like(x)], axis=-1
    )
    wrong = np.abs(found / 255 - colours(rays @ camera.rotation)).max(axis=2)
    shown = np.ones(wrong.shape, bool) if valid is None else valid
    assert np.quantile(wrong[shown], share) < 0.02, (view.name, wrong[shown].max())
    return shown.mean()


@pytest.mark.parametrize("model", sorted(DISTORTION))
def test_an_undistorted_photo_shows_what_its_camera_sees(model, tmp_path):
    values = parameters(model)
    source = photo_of(tmp_path / "a.png", model, values)
    arrays = undistorted_model("model", arrays_of(["a.png"]), [(model, values)])
    (view,) = views_of(arrays, source)
    assert check_colours(view) == 1  # nothing is masked
    assert view.camera.focal == pytest.approx((130, 130), rel=0.1)
    assert 0.8 * SIZE[0] < view.camera.width < 1.3 * SIZE[0]


def test_models_are_all_those_of_colmap():
    assert {*DISTORTION, *PINHOLES, PANORAMA} == {*CAMERA_MODELS}


@pytest.mark.parametrize("model", [PANORAMA, "OPENCV_FISHEYE", "EUCM"])
def test_wide_photos_become_the_faces_of_a_cube(model, tmp_path):
    size = (160, 80) if model == PANORAMA else (160, 150)
    values = tuple(map(float, size)) if model == PANORAMA else (45.0, 45.0, 80.0, 75.0, *DISTORTION[model])
    source = photo_of(tmp_path / "a.png", model, values, size)
    arrays = undistorted_model("model", arrays_of(["far/a.png"], size), [(model, values)])
    views = views_of(arrays, source)
    # at the border of what a lens can show, samples touch pixels that show nothing
    shown = {view.name: check_colours(view, 0.95) for view in views}
    faces = [*FACES] if model == PANORAMA else ["front", "right", "left", "up", "down"]
    assert set(shown) == {f"far/a.{face}.png" for face in faces}
    assert shown["far/a.front.png"] == 1 and list(arrays["files"]) == len(faces) * ["far/a.png"]
    assert all(view.camera.width == pytest.approx(2 * view.camera.focal[0]) for view in views)
    if model != PANORAMA:
        assert 0.2 < shown["far/a.left.png"] < 1


def test_observations_are_those_of_the_faces_that_show_them():
    points = np.array([(0, 0, 5.0), (5, 0.1, 0.2), (0, 0, -5), (0.1, -5, 0), (1, 1, 5)])
    arrays = {
        **arrays_of(["a.png", "b.png"], (160, 80)),
        "points": points,
        "observations": np.array([(0, 0), (1, 0), (2, 0), (3, 0), (4, 1), (0, 1)]),
    }
    arrays["focals"][1], arrays["centres"][1] = 100, (80, 40)
    made = undistorted_model("model", arrays, [(PANORAMA, (160.0, 80.0)), None])
    seen = {(int(point), str(made["names"][view])) for point, view in made["observations"]}
    assert seen == {
        (0, "a.front.png"),
        (1, "a.right.png"),
        (2, "a.back.png"),
        (3, "a.up.png"),
        (4, "b.png"),
        (0, "b.png"),
    }
    assert made["lenses"][-1] is None and tuple(made["focals"][-1]) == (100, 100)


def test_a_strong_pincushion_lens_keeps_its_corners_and_masks_the_rest(tmp_path):
    """The rectangle without uncovered pixels would lose the photo's sides."""
    values = (90.0, 80.0, 60.0, 0.35)
    source = photo_of(tmp_path / "a.png", "SIMPLE_RADIAL", values)
    arrays = undistorted_model("model", arrays_of(["a.png"]), [("SIMPLE_RADIAL", values)])
    (view,) = views_of(arrays, source)
    assert 0.7 < check_colours(view) < 1


@pytest.mark.parametrize("bad", [np.nan, -1e300, 0.0])
@pytest.mark.parametrize("model", sorted(DISTORTION))
def test_parameters_that_describe_no_lens_are_refused_or_bounded(model, bad):
    for place in (0, len(parameters(model)) - 1):
        values = [*parameters(model)]
        values[place] = bad
        try:
            made = undistorted_model("model", arrays_of(["a.png"]), [(model, tuple(values))])
        except InputError as error:
            assert "a.png cannot be undistorted" in str(error)
        else:
            assert (made["sizes"] <= 2 * max(SIZE)).all() and (made["sizes"] > 0).all()
            assert np.isfinite(made["focals"]).all() and np.isfinite(made["centres"]).all()
