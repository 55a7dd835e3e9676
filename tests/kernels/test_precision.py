"""Each switch of tools/studies/precision.py has its effect, and no effect where it is not set."""

import numpy as np
import pytest

from clsplat.bench.workloads import city
from clsplat.device import Kernel, each
from tests import cases
from tests.kernels.chain import camera_of, depth_order, render, size_of
from tests.reference import blend as blend_reference
from tests.reference import project as project_reference
from tools.studies.precision import (
    DEFAULT,
    DOUBLE,
    NO_CUTOFF,
    NO_STOP,
    VARIANTS,
    Devices,
    Frame,
    Variant,
    VariantDevice,
    errors,
)

EXP = """
#include "real.h"
#include "each.h"
#include "splat.h"
#include "footprint.h"
__kernel void take_exp(uint count, __global const real *restrict powers,
                       __global real *restrict results)
{
#if FORM_ITEM
    FOR_EACH(i, count / 16)
        vstore16(exp2_scaled(vload16(i, powers) * (real)LOG2_E, 1), i, results);
#else
    FOR_EACH(i, count)
        results[i] = exp2_where(true, powers[i] * (real)LOG2_E);
#endif
}
"""
# of the polynomials, as exp_power.h says, plus float's rounding of the result and of power log2(e)
LARGEST_ERROR = {3: 7.5e-5, 4: 2.6e-6, 5: 7.5e-8, 6: 3e-9}
ROUNDING = 9e-7


def exp_errors(device, tmp_path, *defines):
    """Relative errors of the exponential over the powers that blending asks for."""
    file = tmp_path / "exp.cl"
    file.write_text(EXP)
    kernel = Kernel(str(file), "take_exp", each("count"), count="uint", powers=("real", "N"),
                    results=("real", "N"))
    powers = np.linspace(-6, 0, 1 << 14).astype(np.float32)
    results = device.empty(len(powers))
    device.launch(kernel, defines, count=len(powers), powers=device.upload(powers),
                  results=results)
    return results.download() / np.exp(powers.astype(np.float64)) - 1


def default_kind(device):
    if device.form == "item":
        return 4
    return 1 if device.capabilities["HAVE_NATIVE_EXP"] else 6


@pytest.mark.parametrize("degree, largest", [
    pytest.param(*item, marks=[pytest.mark.slow] if item[0] < 6 else [])
    for item in LARGEST_ERROR.items()])
def test_polynomials_have_the_error_that_they_claim(float_device, tmp_path, degree, largest):
    error = np.abs(exp_errors(float_device, tmp_path, ("EXP_KIND", degree))).max()
    assert 0.9 * largest < error < largest + ROUNDING


@pytest.mark.slow
@pytest.mark.parametrize("kind", [0, 1])
def test_exp2_and_native_exp2(float_device, tmp_path, kind):
    bound = 1e-6 if kind == 0 else 1e-4  # how good native_exp is is the device's own affair
    assert np.abs(exp_errors(float_device, tmp_path, ("EXP_KIND", kind))).max() < bound


def test_the_default_is_one_of_them(float_device, tmp_path):
    default = exp_errors(float_device, tmp_path)
    assert np.array_equal(default, exp_errors(
        float_device, tmp_path, ("EXP_KIND", default_kind(float_device))))


COUNT = 1200


def scene():
    """As tools/studies/precision.py takes it; opaque in places, so that pixels end."""
    case = cases.gaussians("many", count=COUNT)
    case["rows"]["opacity_logits"] += 3

    class Rows:
        rows, sh_degree, count = case["rows"], 3, COUNT

    return Rows, [camera_of(case)]


def of(knob, name):
    return next(v for v in VARIANTS if (v.knob, v.name) == (knob, name))


def worst(error):
    return max(gradient["l2"] for gradient in error["gradients"].values())


@pytest.mark.slow
def test_variants_change_what_they_must(float_device):
    """Image or gradients differ from the default's wherever a switch is thrown; of a constant the
    value next to the default's is tried, which changes least. Rounding to half is the host's, and
    so is tried in one form; groups of a CPU are slow to compile."""
    devices, small = Devices(float_device.handle, float_device.form), scene()
    default = Frame(devices[DEFAULT], small).result()
    items = float_device.form == "item"
    halves = [v for v in VARIANTS if v.half and items]
    for variant in (DOUBLE, *halves, *(
            of("exponential", f"degree {degree}") for degree in ((4, 5) if items else (5,))),
            of("alpha cutoff", "1/512"), of("transmittance stop", "1e-3")):
        off = errors(Frame(devices[variant], small).result(), default)
        same = {"the default", f"degree {default_kind(float_device)}"}
        assert (off["image_max"] > 0 or worst(off) > 1e-12) == (variant.name not in same), variant


@pytest.mark.slow
def test_flags_reach_the_compiler(item_device):
    devices, small = Devices(item_device.handle, item_device.form), scene()
    flag, define = (Frame(devices[variant], small).result() for variant in (
        Variant("", "", flags=("-DEXP_KIND=3",)), of("exponential", "degree 3")))
    assert errors(flag, define)["image_max"] == 0
    assert errors(flag, Frame(devices[DEFAULT], small).result())["image_max"] > 0


@pytest.mark.slow
def test_a_box_has_more_pairs_and_the_same_image(float_device):
    devices, small = Devices(float_device.handle, float_device.form), scene()
    ellipse = Frame(devices[DEFAULT], small)
    expected, pairs = ellipse.result(), ellipse.run()[0].pairs.count
    box = Frame(devices[of("tiles", "bounding box")], small)
    off = errors(box.result(), expected)
    assert off["image_max"] == 0 and worst(off) < 1e-6
    assert box.run()[0].pairs.count > 1.05 * pairs


@pytest.mark.slow
@pytest.mark.parametrize("defines, alpha_min, transmittance_min, name", [
    ((("ALPHA_STEPS", 64),), 1 / 64, 1e-4, "plain"),
    ((("TRANSMITTANCE_MIN", "1e-2"),), 1 / 255, 1e-2, "stack"),
    (NO_CUTOFF.defines + NO_STOP.defines, 2.0**-24, 0, "stack")])
def test_cuts_are_those_of_the_reference(double_device, monkeypatch, defines, alpha_min,
                                         transmittance_min, name):
    monkeypatch.setattr(blend_reference, "ALPHA_MIN", alpha_min)
    monkeypatch.setattr(blend_reference, "TRANSMITTANCE_MIN", transmittance_min)
    case = cases.gaussians(name)
    splats = project_reference.project(case["rows"], case["camera"], case["degree"], case["near"])
    order = depth_order(splats)
    expected, _, _ = blend_reference.blend(splats, order, *size_of(case), case["background"])
    fragile = blend_reference.fragile_pixels(splats, order, *size_of(case), tolerance=1e-9)
    variant = Variant("", "", defines, precision="double")
    _, _, frame = render(VariantDevice(double_device.handle, variant, double_device.form), case)
    # what is fainter than 2^-24 is left out by bounds of tiles too
    assert np.where(fragile, 0, np.abs(frame.image.download() - expected)).max() < 1e-6


@pytest.mark.slow
def test_half_keeps_eleven_bits(float_device):
    devices, small = Devices(float_device.handle, float_device.form), scene()
    default = Frame(devices[DEFAULT], small).result()
    splats, shapes, sums, scaled = (
        errors(Frame(devices[of("storage", name)], small).result(), default)
        for name in ("splats in half", "splats in half, means in float", "pair sums in half",
                     "pair sums in half, scaled"))
    assert 1e-5 < shapes["image_mean"] < 2**-11 < 4 * splats["image_mean"]
    assert sums["image_max"] == scaled["image_max"] == 0
    assert 1e-5 < worst(scaled) < worst(sums)


@pytest.mark.slow
def test_the_order_of_another_device_is_taken(double_device):
    small = scene()

    def result(keys):
        device = VariantDevice(double_device.handle, DOUBLE, double_device.form, keys)
        return Frame(device, small).result()

    own = Frame(Devices(double_device.handle, double_device.form)[DOUBLE], small)
    plain = own.result()
    assert errors(result(own.depth_keys()), plain)["image_max"] == 0
    all_equal = np.full(COUNT, 7, np.uint32)  # in the order of the rows
    assert errors(result(all_equal), plain)["image_max"] > 0.01


@pytest.mark.slow
def test_frames_that_share_a_device_keep_their_variant(item_device):
    """Variants are timed in turn: each must run as itself, whichever was prepared last."""
    devices, scene = Devices(item_device.handle, item_device.form), city(300, (64, 48))
    coarse = Variant("alpha cutoff", "1/16", (("ALPHA_STEPS", 16),))
    frames = [Frame(devices[variant], scene) for variant in (DEFAULT, coarse)]
    assert frames[0].device is frames[1].device
    first, second = (frame.result()["image"] for frame in frames)
    assert not np.array_equal(first, second)
    assert np.array_equal(first, frames[0].result()["image"])


def test_errors_are_relative_and_name_the_worst():
    image = np.zeros((3, 1, 2))
    reference = {"image": image, "gradients": {"positions": np.array([[3.0, 4.0], [0, 0]])}}
    off = {"image": image + [[[0, 0.5]]],
           "gradients": {"positions": np.array([[3.0, 4.0], [0, 2.0]])}}
    difference = errors(off, reference)
    assert [difference[f"image_{name}"] for name in ("max", "mean", "above")] == [0.5, 0.25, 0.5]
    assert difference["gradients"]["positions"] == {
        "l2": 0.4, "worst": 0.5, "element": "positions[1, 1]"}
