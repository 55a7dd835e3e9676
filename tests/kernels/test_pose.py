"""Corrections of poses: the corrected camera, the gradient of a whole render, sums and steps."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from clsplat.camera import Camera
from clsplat.constants import COUNT_FAILED, COUNT_VISIBLE, POSE_BLOCK
from clsplat.optimise.pose import Poses
from clsplat.placement.corrections import Correction, correction_between
from clsplat.primitives.compact import new_counts
from clsplat.rendering.project import pack_camera
from tests import cases
from tests.checks import close
from tests.kernels import chain
from tests.reference import pose as reference
from tests.reference.blend import blend_adjoint, fragile_pixels
from tests.reference.project import project

DEPTH, PULL, VIEWS, STEP = 3.7, 0.3, 3, 0.01
NAMES = ("poses", "m", "v", "steps")


def in_all_digits(camera):
    """With a rotation that is one in double precision, too."""
    return {**camera, "rotation": Rotation.from_matrix(camera["rotation"]).as_matrix()}


class Run:
    """Poses with random corrections, and the same by the reference."""

    def __init__(self, device, size=0.05, pull=PULL):
        self.device, rng = device, np.random.default_rng(0)
        self.camera = in_all_digits(cases.camera(40, 30, turned=True))
        self.given = chain.camera_of({"camera": self.camera})
        self.packed = pack_camera(device, self.given, 0.01)
        self.poses = Poses(device, VIEWS * [self.given], DEPTH, pull)
        rows = cases.single(rng.normal(0, size, (VIEWS, 6)))
        self.state = rows, 0 * rows, 0 * rows, np.zeros(VIEWS, np.uint32)
        self.poses.upload(dict(zip(NAMES, self.state)))

    def step(self, view, terms, rate=STEP, count=None, counts=None):
        """A step by the first `count` of the terms."""
        count = len(terms) if count is None else count
        counts = new_counts(self.device, count) if counts is None else counts
        self.poses.step(view, rate, self.packed, self.device.upload(terms), counts)
        grad = reference.gradient(self.camera, self.state[0][view], DEPTH, terms[:count].sum(0))
        self.state = reference.step(*self.state, view, grad, rate, self.poses.pull)

    def check(self, what):
        saved = self.poses.download()
        assert set(saved) == set(NAMES)
        for name, expected in zip(NAMES[:3], self.state):
            close(saved[name], expected, chain.precision_of(self.device), f"{what}: {name}")
        assert np.array_equal(saved["steps"], self.state[3]), what


def terms_of(count, seed=0):
    return cases.single(np.random.default_rng(seed).normal(0.5, 1, (count, 6)))


@pytest.mark.oclgrind
@pytest.mark.parametrize("size", [0.0, 1e-4, 0.05, 0.3, 2.0])
@pytest.mark.one_in(2)
def test_the_corrected_camera(device, size):
    """Around the angles where the kernel goes from a series to the formula."""
    run = Run(device, size)
    for view in range(VIEWS):
        expected = reference.apply(run.camera, run.state[0][view], DEPTH)
        actual = run.poses.apply(view, run.packed).download()
        packed = pack_camera(device, chain.camera_of({"camera": expected}), 0.01).download()
        close(actual, packed, chain.precision_of(device), f"view {view}")
        correction = run.poses.corrections()[view]
        host = correction.applied(run.given)
        close(host.rotation, expected["rotation"], "float", "rotation")
        close(host.position, chain.camera_of({"camera": expected}).position, "float", "position")
        if size < 1:  # a turn by less than half a revolution
            back = correction_between(run.given, host)
            assert np.allclose(back.turn, correction.turn, atol=1e-9)
            assert np.allclose(back.shift, correction.shift, atol=1e-9)


@pytest.mark.double
@pytest.mark.parametrize("name, antialiased", [("plain", False), ("degree_2", True), ("needles", False)])
@pytest.mark.one_in(3)
def test_the_gradient_of_a_render(device, name, antialiased):
    """The reference is checked by finite differences (tests/reference/test_pose.py)."""
    case = cases.gaussians(name)
    case["camera"] = in_all_digits(case["camera"])
    arguments = case["camera"], case["degree"], case["near"]
    splats = project(case["rows"], *arguments, antialiased=antialiased)
    order, rng = chain.depth_order(splats), np.random.default_rng(1)
    fragile = fragile_pixels(splats, order, *chain.size_of(case))
    cotangents = [np.where(fragile, 0, rng.normal(size=(*channels, *fragile.shape))) for channels in ((3,), (), ())]
    by_splat = blend_adjoint(splats, order, *chain.size_of(case), case["background"], *cotangents)
    expected = reference.terms(case["rows"], *arguments, antialiased, grads=by_splat)
    renderer = chain.renderer_of(device, case, antialiased=antialiased)
    rows = chain.upload_rows(device, case["rows"])
    frame = renderer.render(rows, renderer.pack(chain.camera_of(case)), *chain.size_of(case), case["degree"], True)
    gradients = renderer.adjoint(
        rows,
        frame,
        *map(device.upload, cotangents),
        with_pose=True,
        frozen=device.upload(np.ones(len(expected), np.uint32)),
    )
    visible = frame.visible.download()
    actual = gradients.pose_terms.download()
    close(actual[:, :3], expected[visible, :3], chain.precision_of(device), f"{name}: by a turn")
    close(actual[:, 3:], expected[visible, 3:], chain.precision_of(device), f"{name}: by positions")
    plain = renderer.adjoint(rows, frame, *map(device.upload, cotangents))
    assert plain.pose_terms is None
    assert np.array_equal(plain.fields["positions"].download(), gradients.fields["positions"].download())


@pytest.mark.oclgrind
@pytest.mark.parametrize("count", [0, 1, POSE_BLOCK - 1, POSE_BLOCK, POSE_BLOCK + 1, 17 * POSE_BLOCK + 3])
@pytest.mark.one_in(2)
def test_steps_by_any_number_of_gaussians(device, count):
    """The array has room for more, whose content does not count."""
    run, terms = Run(device), terms_of(count + 5)
    terms[count:] = np.nan
    run.step(1, terms, count=count)
    run.step(1, terms, count=count)
    run.check(f"{count} gaussians")


def test_views_step_by_their_own_count(device):
    run = Run(device)
    for seed, view in enumerate((2, 0, 2, 1, 0, 2)):
        run.step(view, terms_of(33, seed))
    run.check("six steps")
    assert run.state[3].tolist() == [2, 1, 3]


@pytest.mark.parametrize("value", list(cases.POISON.values()), ids=list(cases.POISON))
@pytest.mark.one_in(3)
def test_poison_leaves_the_pose_alone(float_device, value):
    run, terms = Run(float_device), terms_of(50)
    run.step(1, terms)
    before = run.poses.download()
    poisoned = terms.copy()
    poisoned[7, 4] = value
    with np.errstate(all="ignore"):
        usable = bool(np.isfinite(np.float32(DEPTH * poisoned[:, 3:].sum(0)) ** 2).all())
        run.poses.step(1, STEP, run.packed, float_device.upload(poisoned), new_counts(float_device, 50))
    after = run.poses.download()
    assert all(np.isfinite(values).all() for values in after.values())
    assert run.poses.skipped.download()[0] == (not usable)
    assert np.array_equal(after["poses"], before["poses"]) != usable
    run.poses.upload(before)
    run.step(1, terms)
    run.check("the step after")


def test_a_frame_that_failed_changes_nothing(device):
    run, counts = Run(device), new_counts(device)
    numbers = np.zeros(len(counts), np.uint32)
    numbers[[COUNT_FAILED, COUNT_VISIBLE]] = 1, 10**6  # more than there is room for
    counts.write(numbers)
    for terms in (terms_of(9), terms_of(9) * np.nan):
        run.poses.step(0, STEP, run.packed, device.upload(terms), counts)
    run.check("failed")
    assert run.poses.skipped.download()[0] == 0


def around(count=6):
    """Cameras on a ring, and what turns and shifts all of them alike."""
    angles = np.linspace(0, 5, count)
    return [Camera.looking_at((1, 2, 0), (8 * np.cos(a), 8 * np.sin(a), 5 + a)) for a in angles]


def test_recentring_removes_a_common_motion_and_nothing_else(double_device):
    cameras, rng = around(), np.random.default_rng(0)
    a, b = np.array([0.002, -0.001, 0.003]), np.array([0.01, 0.02, -0.03])
    turned = reference.exponential(a)[0]
    moved = []
    for camera in cameras:
        rotation = camera.rotation @ turned.T
        moved.append(
            Camera(
                camera.width,
                camera.height,
                camera.focal,
                camera.centre,
                rotation,
                -rotation @ (turned @ camera.position + b),
            )
        )
    poses = Poses(double_device, cameras, DEPTH)

    def write(corrections):
        poses.poses.write(np.array([[*c.turn, *(c.shift / DEPTH)] for c in corrections]))
        poses.recentre()
        return poses.poses.download()

    common = [correction_between(*pair) for pair in zip(cameras, moved)]
    assert max(c.degrees for c in common) > 0.1
    assert np.abs(write(common)).max() < 2e-5  # to first order of 0.004 rad
    noise = [Correction(*rng.normal(0, 1e-4, (2, 3))) for _ in cameras]
    own = write(noise)
    assert np.allclose(write([Correction(row[:3], DEPTH * row[3:]) for row in own]), own, atol=1e-8)
    both = write([correction_between(given, n.applied(camera)) for given, n, camera in zip(cameras, noise, moved)])
    assert np.allclose(both, own, atol=2e-5) and np.abs(own).max() > 1e-4
