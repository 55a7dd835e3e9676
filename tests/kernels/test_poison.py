"""Numbers that no scene should hold, in each slot in turn: only the gaussian that has one suffers.

The image and the gradients of all others stay finite; a gaussian whose own gradient is not finite
is marked, so that the optimiser leaves it alone, and counted.
"""

import numpy as np
import pytest

from clsplat.constants import NO_ROW
from tests import cases
from tests.kernels import chain

POISONED = 5
SLOTS = {
    "positions": [(0,), (1,), (2,)],
    "log_scales": [(0,), (2,)],
    "quaternions": [(0,), (3,)],
    "opacity_logits": [()],
    "sh_constant": [(1,)],
    "sh_rest": [(0, 0), (2, 2)],
}


def scene():
    return chain.small_scene(3, count=16, width=33, height=17)


def survives(device, case, what):
    """Render and go back; returns the rows marked as not finite."""
    width, height = chain.size_of(case)
    renderer, rows, frame = chain.render(device, case)
    visible, image = frame.visible.download(), frame.image.download()
    assert np.isfinite(image).all(), f"{what}: the image is not finite"
    gradients = renderer.adjoint(rows, frame, device.upload(np.random.default_rng(0).normal(size=(3, height, width))))
    active = gradients.rows.download()
    marked = visible[active == NO_ROW]
    assert set(marked) <= {POISONED}, f"{what}: gradients of {marked} are not finite"
    assert np.array_equal(active[active != NO_ROW], visible[active != NO_ROW])
    assert renderer.skipped.download()[0] == len(marked), f"{what}: not counted"
    for name, values in gradients.fields.items():
        values = values.download()[active != NO_ROW]
        if name == "sh_rest":
            values = values[:, : case["degree"] * (case["degree"] + 2)]
        with np.errstate(over="ignore"):  # Adam squares it
            assert np.isfinite(values**2).all(), f"{what}: gradient of {name} overflows, not marked"
    return marked


@pytest.mark.one_in(2)
@pytest.mark.parametrize("name", SLOTS)
def test_poison_stays_with_its_gaussian(float_device, name):
    case = scene()
    for slot in SLOTS[name]:
        for label, value in cases.POISON.items():
            rows = cases.poisoned(case["rows"], name, (POISONED, *slot), value)
            survives(float_device, {**case, "rows": rows}, f"{name}{list(slot)} = {label}")


def test_gradients_whose_squares_overflow_are_marked(float_device):
    """Adam would keep an infinite second moment, and the next step would be nan."""
    case = scene()
    width, height = chain.size_of(case)
    renderer, rows, frame = chain.render(float_device, case)
    gradients = renderer.adjoint(rows, frame, float_device.upload(np.full((3, height, width), 1e20)))
    marked = gradients.rows.download() == NO_ROW
    opacity = gradients.fields["opacity_logits"].download()
    assert np.isfinite(opacity).all() and (np.abs(opacity[~marked]) < 1e19).all()
    assert marked.sum() == renderer.skipped.download()[0] > len(marked) / 2
