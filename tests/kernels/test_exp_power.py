"""The exponential of blending has the error that cl/include/exp_power.h claims."""

import numpy as np
import pytest

from clsplat.device import Kernel, each

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
    kernel = Kernel(str(file), "take_exp", each("count"), count="uint", powers=("real", "N"), results=("real", "N"))
    powers = np.linspace(-6, 0, 1 << 14).astype(np.float32)
    results = device.empty(len(powers))
    device.launch(kernel, defines, count=len(powers), powers=device.upload(powers), results=results)
    return results.download() / np.exp(powers.astype(np.float64)) - 1


def default_kind(device):
    if device.form == "item":
        return 4
    return 1 if device.capabilities["HAVE_NATIVE_EXP"] else 6


@pytest.mark.parametrize(
    "degree, largest",
    [pytest.param(*item, marks=[pytest.mark.slow] if item[0] < 6 else []) for item in LARGEST_ERROR.items()],
)
def test_polynomials_have_the_error_that_they_claim(float_device, tmp_path, degree, largest):
    error = np.abs(exp_errors(float_device, tmp_path, ("EXP_KIND", degree))).max()
    assert 0.9 * largest < error < largest + ROUNDING


def test_the_default_is_one_of_them(float_device, tmp_path):
    default = exp_errors(float_device, tmp_path)
    assert np.array_equal(default, exp_errors(float_device, tmp_path, ("EXP_KIND", default_kind(float_device))))
