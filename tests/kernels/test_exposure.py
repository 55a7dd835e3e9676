"""Colour transforms of views: gradients and steps, on images around the size of a block (their
values: test_blend.py)."""

import numpy as np
import pytest

from clsplat.camera import Camera
from clsplat.constants import COUNT_FAILED
from clsplat.loss.exposure import Exposures
from clsplat.primitives.compact import new_counts
from clsplat.rendering.project import pack_camera
from clsplat.response import Lenses, Response
from tests import cases
from tests.checks import close
from tests.kernels.chain import precision_of
from tests.reference import exposure as reference

# one pixel, less than 16, a block but one, a block, one more, ragged over several
SIZES = ((1, 1), (7, 2), (23, 89), (64, 32), (683, 3), (61, 137))
RATE, PULL, VIEWS = 0.05, 0.3, 3
LENS_OF = (0, 1, 0, 0, 0)  # of the views
NAMES = ("transforms", "m", "v", "steps")
LENS_NAMES = ("lenses", "lens_m", "lens_v", "lens_steps")
with_parts = pytest.mark.parametrize("parts", [{}, {"vignetting": True}], ids=["plain", "vignetting"])


def camera_of(width, height):
    """One whose optical axis is off the centre, with two focal lengths."""
    return Camera(width, height, (0.9 * width, 1.1 * width), (0.47 * width, 0.55 * height), np.eye(3), np.zeros(3))


class Run:
    """Exposures with random transforms and lenses, and the same by the reference."""

    def __init__(self, device, views=VIEWS, pull=PULL, seed=0, vignetting=False):
        self.device, self.pull, self.rng = device, pull, np.random.default_rng(seed)
        away = cases.single(self.rng.normal(0, 0.2, (views, 3, 4)))
        lenses = cases.single(np.column_stack([self.rng.normal(0, 0.3, (2, 3)), [0.8, 1.3]]))
        self.vignetting = vignetting
        self.exposures = Exposures(
            device, views, RATE, pull, lenses=Lenses(np.array(LENS_OF[:views]), lenses) if vignetting else None
        )
        zero = np.zeros(away.shape)
        self.state = np.eye(3, 4) + away, zero, zero, np.zeros(views, np.uint32)
        self.lens_state = lenses, np.zeros((2, 3)), np.zeros((2, 3)), np.zeros(2, np.uint32)
        self.exposures.upload(
            {
                **dict(zip(NAMES, (values.reshape(views, -1) for values in self.state))),
                "steps": self.state[3],
                "recentred": self.state[0],
                **dict(zip(LENS_NAMES, self.lens_state)),
            }
        )

    def of_lens(self, lens):
        """Its vignetting, if it is learned."""
        return self.lens_state[0][lens] if self.vignetting else reference.NO_LENS

    def step(self, view, image, grad):
        """The gradient by the image, checked; then a step by both."""
        lens = LENS_OF[view]
        row = self.of_lens(lens)
        u = reference.radius(camera_of(*image.shape[:0:-1]), row)
        expected, by_transform, by_lens = reference.apply_adjoint(self.state[0][view], image, grad, row, u)
        actual = stepped(self.exposures, view, self.device.upload(image), self.device.upload(grad))
        close(actual.download(), expected, precision_of(self.device), "gradient")
        if np.isfinite(by_transform).all():
            self.state = reference.step(*self.state, view, by_transform, RATE, self.pull)
            if self.vignetting:
                self.lens_state = reference.lens_step(*self.lens_state, lens, by_lens, RATE, self.pull)

    def check(self, what):
        saved = self.exposures.download()
        states = dict(zip(NAMES, self.state))
        if self.vignetting:
            states |= dict(zip(LENS_NAMES, self.lens_state))
        assert set(saved) == {*states, "recentred"}
        for name, expected in states.items():
            if expected.dtype == np.uint32:
                assert np.array_equal(saved[name], expected), what
            else:
                close(saved[name], expected.reshape(saved[name].shape), precision_of(self.device), f"{what}: {name}")


def stepped(exposures, view, image, grad, counts=None):
    """The gradient by the image, and a step by it."""
    device, (_, height, width) = exposures.device, image.shape
    camera = pack_camera(device, camera_of(width, height), 0.01)
    grad_image, partials = exposures.adjoint(view, camera, image, grad)
    exposures.step(view, partials, new_counts(device) if counts is None else counts)
    return grad_image


def a_pair(width, height, seed=0):
    """An image and a gradient by the result, which does not sum to nearly nothing."""
    image, other = cases.images(width, height, seed)
    return image, cases.single(other - 0.3)


@pytest.mark.double
@pytest.mark.oclgrind
@with_parts
@pytest.mark.parametrize("size", SIZES, ids=str)
@pytest.mark.one_in(5)
def test_gradient_and_steps(device, size, parts):
    run, (image, grad) = Run(device, **parts), a_pair(*size)
    run.step(1, image, grad)
    run.check("a first step")


@with_parts
def test_views_and_lenses_step_by_their_own_count(device, parts):
    run = Run(device, **parts)
    for seed, view in enumerate((2, 0, 2, 1, 0, 2)):
        run.step(view, *a_pair(33, 17, seed))
    run.check("six steps")
    assert run.state[3].tolist() == [2, 1, 3]
    assert not parts or run.exposures.lens_steps.download().tolist() == [5, 1]


@with_parts
@pytest.mark.parametrize("slot", ["image", "grad"])
def test_poison_leaves_the_row_and_other_pixels_alone(float_device, slot, parts):
    clean = dict(zip(("image", "grad"), a_pair(61, 37)))
    for label, value in cases.POISON.items():
        arrays = cases.poisoned(clean, slot, (1, 20, 30), value)
        run = Run(float_device, **parts)
        row = run.of_lens(0)
        before = run.exposures.download()
        with np.errstate(all="ignore"):
            actual = stepped(
                run.exposures, 0, *(float_device.upload(arrays[name]) for name in ("image", "grad"))
            ).download()
            expected, *sums = reference.apply_adjoint(
                run.state[0][0], arrays["image"], arrays["grad"], row, reference.radius(camera_of(61, 37), row)
            )
            usable = all(np.isfinite(np.float32(values) ** 2).all() for values in sums)
        after = run.exposures.download()
        assert all(np.isfinite(values).all() for values in after.values()), label
        assert after["steps"].tolist() == [int(usable), 0, 0], label
        assert not parts or after["lens_steps"].tolist() == [int(usable), 0], label
        assert run.exposures.skipped.download()[0] == (not usable), label
        unchanged = [
            np.array_equal(after[name], before[name]) for name in before if name not in ("recentred", "lenses")
        ]
        assert any(unchanged) != usable, label
        actual[:, 20, 30] = expected[:, 20, 30] = 0
        close(actual, expected, "float", label)


def test_a_frame_that_failed_changes_nothing(device):
    """Nor is its gradient, which may be anything, counted as one that is not finite."""
    run, (image, grad) = Run(device), a_pair(33, 17)
    counts = new_counts(device)
    counts.write(np.eye(1, len(counts), COUNT_FAILED, dtype=np.uint32)[0])
    for bad in (grad, grad * np.nan):
        stepped(run.exposures, 1, device.upload(image), device.upload(bad), counts)
    run.check("failed")
    assert run.state[3].tolist() == [0, 0, 0] and run.exposures.skipped.download()[0] == 0


def test_recentring_makes_the_mean_the_identity_and_keeps_differences(device):
    run = Run(device, views=5)
    before = run.exposures.download()
    run.exposures.recentre()
    after = run.exposures.download()
    rows = after.pop("transforms").astype(float)
    close(rows.mean(axis=0), np.eye(3, 4).ravel(), precision_of(device), "mean")
    known = after.pop("recentred").reshape(5, 12)
    close(known, rows, precision_of(device), "what `between` goes by")
    moved = before.pop("transforms") - rows
    close(moved, np.tile(moved[0], (5, 1)), precision_of(device), "differences")
    assert np.abs(moved).max() > 0.01
    assert all(np.array_equal(after[name], before[name]) for name in after)


def test_the_mean_at_the_start_is_kept(device):
    """As blocks of a city need it, whose views are not all of the city's."""
    initial = np.eye(3, 4) + cases.single(np.random.default_rng(0).normal(0, 0.1, (3, 3, 4)))
    exposures = Exposures(device, 3, RATE, initial=initial)
    image, grad = (device.upload(values) for values in a_pair(20, 10))
    for _ in range(3):
        stepped(exposures, 1, image, grad)
    exposures.recentre()
    rows = exposures.download()["transforms"].reshape(3, 3, 4)
    assert np.abs(rows[1] - initial[1]).max() > 0.05
    assert np.allclose(rows.mean(axis=0), initial.mean(axis=0), atol=1e-6)
    rest = exposures.between([(0, 1)]).download()
    again = Exposures(device, 3, initial=rows.astype(float)).between([(0, 1)]).download()
    assert np.allclose(rest, again, atol=1e-5)


def test_between_takes_one_photos_colours_to_anothers(device):
    run, image = Run(device), cases.images(20, 10)[0]
    seen = [reference.apply(transform, image) for transform in run.state[0]]
    for i, j in ((0, 1), (2, 0), (1, 1)):
        rows = run.exposures.between([(2, 2), (i, j)])
        assert rows.shape == (2, 12) and rows.dtype == device.real
        actual = rows.download()[1].reshape(3, 4)
        close(actual, reference.between(run.state[0][i], run.state[0][j]), precision_of(device), f"{j} to {i}")
        close(reference.apply(actual, seen[j]), seen[i], precision_of(device), "colours")


@pytest.mark.parametrize("last", [[0, 0, 0], [1, 0, 0], [0, 1, 1e-6]], ids=str)
def test_between_is_the_identity_where_there_is_no_way_back(device, last):
    run = Run(device)
    transforms = run.state[0].copy()
    transforms[1, :, :3] = np.diag([1, 1, 0]) + [[0] * 3, [0] * 3, last]
    run.exposures.upload({**run.exposures.download(), "recentred": transforms})
    assert np.array_equal(run.exposures.between([(0, 1)]).download()[0], np.eye(3, 4).ravel())


def test_responses_are_what_the_kernels_apply(device):
    """By the host and by the reference: what an evaluation shows is what was learned."""
    run = Run(device, vignetting=True)
    camera, image = camera_of(40, 30), cases.images(40, 30)[0]
    for view, response in enumerate(run.exposures.responses()):
        row = run.of_lens(LENS_OF[view])
        expected = reference.apply(run.state[0][view], image, row, reference.radius(camera, row))
        actual = response.applied(image.transpose(1, 2, 0), camera).transpose(2, 0, 1)
        close(actual, expected, "float", "response")
        assert response.has_vignetting
    without = Run(device).exposures.responses()[0]
    assert isinstance(without, Response) and not without.has_vignetting


def test_first_and_late_steps_are_corrected(device):
    for count in (0, 7, 999, 10**6):
        run = Run(device)
        run.state[3][:] = count
        run.exposures.steps.write(run.state[3])
        run.step(0, *a_pair(16, 16))
        run.check(f"after {count} steps")


@pytest.mark.slow
def test_sums_over_a_million_pixels_keep_their_digits(device):
    """All of one sign, the worst for sums that lose what is small beside them."""
    run, rng = Run(device, pull=0.0), np.random.default_rng(1)
    image, grad = cases.single(rng.uniform(0.1, 1, (2, 3, 1000, 1009)))
    run.step(0, image, grad)
    sums = reference.apply_adjoint(run.state[0][0], image, grad)[1]
    close(10 * run.exposures.download()["m"][0], sums.ravel(), precision_of(device), "sums")
