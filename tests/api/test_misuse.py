"""Misuse of the Python API: one line with cause and cure, and no kernel beyond a buffer."""

from dataclasses import replace

import numpy as np
import pytest

import clsplat
from clsplat.gaussians import LEARNED

DOWN = clsplat.Camera.looking_at((0, 0, 0), (0, 0, -4), up=(0, 1, 0), width=24, height=16)
NAN = float("nan")


def rows(count=5, degree=1):
    return {field.name: np.full((count, *field.row_shape(degree)), 0.1, np.float32) for field in LEARNED}


def without(name):
    return {key: values for key, values in rows().items() if key != name}


@pytest.mark.parametrize(
    "given, degree, words",
    [
        (rows(degree=3), 7, "sh_degree 7: expects 0, 1, 2 or 3"),
        (rows(degree=3), 4, "sh_degree 4"),
        (rows(), -1, "sh_degree -1"),
        (rows(), 1.0, "sh_degree"),
        (rows(), None, "sh_degree None"),
        (rows(), "1", "sh_degree '1'"),
        (rows(degree=1), 3, r"sh_rest: has shape \(5, 3, 3\), not \(5, 15, 3\)"),
        (rows(degree=3), 2, "sh_rest: has shape"),
        (rows(), 0, "sh_rest: has shape"),
        *((without(field.name), 1, f"{field.name}: ") for field in LEARNED),
        ({**rows(), "log_scales": np.zeros((4, 3), np.float32)}, 1, "log_scales: has shape"),
        ({**rows(), "quaternions": np.zeros((5, 3), np.float32)}, 1, "quaternions: has shape"),
        ({**rows(), "opacity_logits": np.zeros((5, 1), np.float32)}, 1, "opacity_logits: has shape"),
        ({**rows(), "positions": np.zeros((5, 3), complex)}, 1, "is complex128; give a numpy array"),
        ({**rows(), "positions": np.array([["a"] * 3] * 5)}, 1, "of real numbers"),
        ({**rows(), "positions": [[0, 0, 0]]}, 1, "list.*; give a numpy array"),
        ({**rows(), "positions": np.float32(3)}, 1, "positions: "),
        ({**rows(), "anchors": np.zeros((2, 3), np.float32)}, 1, "anchors: has shape"),
        ([], 1, "rows: expects a dict"),
        (None, 1, "rows: expects a dict"),
    ],
)
def test_a_model_is_checked_as_a_whole(given, degree, words):
    with pytest.raises(clsplat.ClsplatError, match=words):
        clsplat.Gaussians(given, degree)


def test_other_real_numbers_and_no_gaussians_are_a_model():
    whole = {name: values.astype(">f8") for name, values in rows().items()}
    assert clsplat.Gaussians(whole, np.int64(1)).count == 5
    assert clsplat.Gaussians(rows(0, 0), 0).count == 0
    with pytest.raises(clsplat.ClsplatError, match="offset"):
        clsplat.Gaussians(rows(), 1, np.array([0, NAN, 0]))


@pytest.mark.parametrize(
    "changes, words",
    [
        ({"width": -5}, "width -5"),
        ({"width": 64.5}, "width 64.5"),
        ({"height": 0}, "height 0"),
        ({"width": True}, "width True"),
        ({"width": 10**9}, "from 1 to 65,536"),
        ({"height": "a"}, "height 'a'"),
        ({"focal": (0.0, 0.0)}, "focal"),
        ({"focal": (NAN, 9.0)}, "focal"),
        ({"focal": (9.0, 1e-300)}, "focal"),
        ({"focal": 9.0}, "focal 9.0: expects 2 finite numbers"),
        ({"focal": (-9.0, 9.0)}, "focal"),
        ({"centre": (np.inf, 0.0)}, "centre"),
        ({"rotation": np.full((3, 3), NAN)}, "rotation"),
        ({"rotation": 5 * np.eye(3)}, "orthogonal"),
        ({"rotation": np.diag([1.0, 1, -1])}, "mirror image"),
        ({"rotation": np.eye(2)}, "3 x 3"),
        ({"translation": np.array([0, NAN, 0])}, "translation"),
        ({"translation": "abc"}, "expects n"),
        ({"offset": np.zeros(2)}, "offset"),
    ],
)
def test_a_camera_that_can_draw_nothing_is_one_line(changes, words):
    with pytest.raises(clsplat.ClsplatError, match=words) as error:
        clsplat.render(clsplat.Gaussians(rows(), 1), replace(DOWN, **changes))
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    "arguments, words",
    [
        ({"background": (1, 1)}, "background .*: expects 3 finite numbers"),
        ({"background": (1, 1, 1, 1, 1)}, "background"),
        ({"background": "red"}, "background red"),
        ({"background": (0, 0, NAN)}, "background"),
        ({"background": None}, "background"),
        ({"background": (1j, 0, 0)}, "background"),
        ({"near": NAN}, "near nan"),
        ({"near": 0}, "near 0: expects a depth above 0"),
        ({"near": -1.0}, "near -1"),
        ({"near": "close"}, "near close"),
        ({"near": (1, 2)}, "near"),
        ({"device": "cpu"}, "give clsplat.Device"),
        ({"model": None}, "not gaussians"),
        ({"model": "model.ply"}, "Gaussians.load"),
        ({"camera": None}, "not a camera"),
        ({"cameras": [None]}, "not both"),
    ],
)
def test_an_argument_of_render_is_one_line(arguments, words):
    given = {"model": clsplat.Gaussians(rows(), 1), "camera": DOWN, **arguments}
    with pytest.raises(clsplat.ClsplatError, match=words):
        clsplat.render(given.pop("model"), given.pop("camera"), **given)


def test_a_renderer_on_the_default_device_refuses_what_does_not_fit():
    renderer = clsplat.Renderer(clsplat.Gaussians(rows(), 1))
    before = renderer.download().positions
    for name, values, words in (
        ("positions", "abc", "expects real numbers"),
        ("positions", None, "expects real"),
        ("positions", np.zeros((5, 3), complex), "expects real numbers"),
        ("positions", [[1, 2, 3], [4]], "expects real numbers"),
        ("positions", np.zeros((4, 3)), "has shape"),
        ("nothing", 3, "not a field"),
        ("sh_rest", np.zeros((5, 15, 3)), "has shape"),
        ("anchors", 3, "not a field"),
    ):
        with pytest.raises(clsplat.ClsplatError, match=words):
            renderer.update(**{"log_scales": np.ones((5, 3)), name: values})
    now = renderer.download()
    assert np.array_equal(now.positions, before) and now.log_scales.max() < 1  # nothing was written
    frame = renderer.forward(DOWN)
    with pytest.raises(clsplat.ClsplatError, match="expects real numbers"):
        renderer.backward(frame, "abc")


@pytest.mark.parametrize("folder", ["run", None, 3])
def test_a_run_says_how_it_is_opened(folder):
    with pytest.raises(clsplat.ClsplatError, match="Run.open"):
        clsplat.Run(folder)
