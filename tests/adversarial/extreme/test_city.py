"""The figure of float32: a city's image within 1e-4 of float64, each gradient within 1e-4."""

import pytest

from clsplat.device import Device
from tests.adversarial.extreme.cases import ORDINARY
from tests.adversarial.extreme.city import measure_city


@pytest.mark.slow
def test_float_agrees_with_double(float_device):
    """With fewer gaussians where groups run on a CPU."""
    count = 100_000 if float_device.form == "item" else 30_000
    if not float_device.capabilities["HAVE_DOUBLE"]:
        pytest.skip(f"{float_device.name} has no double precision")
    double = Device(float_device.handle, precision="double", form=float_device.form)
    found = measure_city(float_device, double, count)
    assert found.compared > 0.98, f"thresholds decide {1 - found.compared:.1%} of the pixels"
    assert found.unsorted < 1e-3, f"{found.unsorted:.2%} of the pixels depend on rounded depths"
    for name, error in {"image": found.image, **found.gradients}.items():
        assert error.value <= ORDINARY, (
            f"{count} gaussians: {name} is off by {error.value:.3g} where {ORDINARY:.3g} is "
            f"allowed; the worst element {error.worst}")
