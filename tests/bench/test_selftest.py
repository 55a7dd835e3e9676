"""The self-test passes on a working device, and names what is broken on any other.

python -m tests.bench.test_selftest     writes the stored results again
"""

import itertools

import numpy as np
import pytest

from clsplat.bench import selftest
from clsplat.densify.scores import Statistics
from clsplat.device import Device
from clsplat.loss.image_loss import image_loss
from clsplat.optimise.adam import DeviceAdam
from clsplat.primitives.compact import compact
from clsplat.primitives.gather import gather
from clsplat.primitives.sort import stable_sort
from clsplat.rendering.bin import bin_splats
from clsplat.rendering.pipeline import Renderer
from tests.reference import selftest as reference

BACKGROUND_NOISE = itertools.count()


def unsorted(device, keys, counts):
    return keys, stable_sort(device, keys, counts)[1]


def first_row_everywhere(device, rows, indices):
    return gather(device, rows, device.zeros(len(indices), np.uint32))


def one_too_few(*arguments):
    kept = compact(*arguments)
    return kept.narrow(len(kept) - 1)


def unstable_lists(*arguments):
    pairs = bin_splats(*arguments)
    listed = pairs.sorted_splats.download()
    listed[[4000, 4001]] = listed[[4001, 4000]]
    pairs.sorted_splats.write(listed)
    return pairs


class WithoutCorrection(DeviceAdam):
    def numbers(self, step, rates):
        return super().numbers(1000, rates)


class CountsTwice(Statistics):
    def mean_gradient(self):
        return super().mean_gradient() / 2


def other_value(device, *arguments):
    partials, grad = image_loss(device, *arguments)
    return device.upload(partials.download() * 1.001), grad


def other_gradient(device, *arguments):
    partials, grad = image_loss(device, *arguments)
    return partials, device.upload(grad.download() * 1.1)


def brighter(device, *arguments, background, **options):
    return Renderer(device, *arguments, background=np.add(background, 1e-4), **options)


def restless(device, *arguments, background, **options):
    """Within the bound of single precision, but never the same twice."""
    noise = 1e-7 * (1 + next(BACKGROUND_NOISE) % 2)
    return Renderer(device, *arguments, background=np.add(background, noise), **options)


class HalfTheTurn(Renderer):
    def adjoint(self, *arguments, **options):
        gradients = super().adjoint(*arguments, **options)
        turned = gradients.fields["quaternions"]
        turned.write(turned.download() / 2)
        return gradients


def failures(results):
    return [name.split(",")[0] for name, passed, _ in results if not passed]


def results(device, checks=selftest.CHECKS):
    return [selftest._result(device, *row) for row in checks]


@pytest.mark.one_in(5)
def test_a_working_device_passes(float_device):
    assert not failures(results(float_device)), results(float_device)


@pytest.mark.slow
@pytest.mark.parametrize(
    "part, broken, line",
    [
        ("stable_sort", unsorted, "sort"),
        ("gather", first_row_everywhere, "sort"),
        ("compact", one_too_few, "sort"),
        ("bin_splats", unstable_lists, "tile lists"),
        ("DeviceAdam", WithoutCorrection, "Adam"),
        ("Statistics", CountsTwice, "render adjoint"),
        ("image_loss", other_value, "image loss and its adjoint"),
        ("image_loss", other_gradient, "image loss and its adjoint"),
        ("Renderer", brighter, "render"),
        ("Renderer", HalfTheTurn, "render adjoint"),
        ("Renderer", restless, "same bytes twice"),
    ],
)
@pytest.mark.one_in(2)
def test_a_broken_part_fails_its_line_only(float_device, monkeypatch, part, broken, line):
    monkeypatch.setattr(selftest, part, broken)
    assert failures(results(float_device)) == [line]


def test_what_a_driver_raises_is_one_line(float_device, monkeypatch):
    def broken(device, keys, counts):
        raise RuntimeError("clEnqueueNDRangeKernel failed:\n OUT_OF_RESOURCES")

    monkeypatch.setattr(selftest, "stable_sort", broken)
    [(name, passed, detail)] = results(float_device, selftest.CHECKS[:1])
    assert name.startswith("sort") and not passed
    assert detail == "RuntimeError: clEnqueueNDRangeKernel failed: OUT_OF_RESOURCES"


def test_check_covers_both_forms(item_device, monkeypatch):
    monkeypatch.setattr(selftest, "CHECKS", selftest.CHECKS[:1])
    assert [(name, passed) for name, passed, _ in selftest.check(item_device)] == [
        (f"sort, gather and compaction, {form} form", True) for form in ("item", "group")
    ]


def test_check_has_the_sizes_of_the_device(item_device, monkeypatch):
    device = Device(item_device.handle, tuning={**item_device.tuning, "item_runs": 16})
    monkeypatch.setattr(selftest, "CHECKS", [("sizes", 0, lambda made: [(made.item_runs, 16)])])
    assert [passed for _, passed, _ in selftest.check(device)] == [True, True]


def by_the_reference():
    return reference.stored(
        selftest.CAMERA,
        selftest.NEAR,
        selftest.BACKGROUND,
        selftest.DEGREE,
        selftest.SSIM_WEIGHT,
        selftest.RATES,
        selftest.LATER,
    )


def test_the_stored_results_are_those_of_the_reference():
    fresh = by_the_reference()
    assert selftest.stored().keys() == fresh.keys()
    for name, values in fresh.items():
        np.testing.assert_allclose(selftest.stored()[name], values, 1e-6, 1e-9, err_msg=name)


if __name__ == "__main__":
    np.savez_compressed(selftest.STORED, **by_the_reference())
