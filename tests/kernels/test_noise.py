"""Random steps of the positions against the reference."""

import numpy as np
import pytest

from clsplat.constants import COUNT_FAILED, FRAME_COUNTS
from clsplat.optimise.noise import SEEDS, add_noise
from clsplat.primitives.compact import new_counts
from tests import cases
from tests.checks import close
from tests.kernels.chain import precision_of, upload_rows
from tests.reference import noise as reference

FIELDS = ("positions", "log_scales", "quaternions", "opacity_logits")
AMOUNT, NOW, SEED = 80.0, 1234, 7
POISONED = 5


def some_rows(count, seed=0):
    """Gaussians from transparent to opaque, in single precision's numbers."""
    rng = np.random.default_rng(seed)
    rows = {
        "positions": rng.normal(size=(count, 3)),
        "log_scales": rng.normal(-4, 1, (count, 3)),
        "quaternions": rng.normal(size=(count, 4)),
        "opacity_logits": rng.uniform(-9, 3, count),
    }
    return {name: values.astype(np.float32).astype(np.float64) for name, values in rows.items()}


def moves(device, rows, amount=AMOUNT, now=NOW, seed=SEED, frozen=None, counts=None):
    """By how much each position changes, float64[N, 3]."""
    on_device = upload_rows(device, rows)
    add_noise(
        on_device,
        amount,
        now,
        seed,
        counts or new_counts(device),
        None if frozen is None else device.upload(frozen.astype(np.uint32)),
    )
    return on_device["positions"].download().astype(np.float64) - rows["positions"]


@pytest.mark.double
@pytest.mark.oclgrind
def test_against_the_reference(device):
    group = device.group_size
    for count in (1, group - 1, group, group + 1, 3 * group + 7):
        # at the origin, or rounding to the position would hide how exact the step is
        rows = {**some_rows(count), "positions": np.zeros((count, 3))}
        frozen = np.random.default_rng(1).random(count) < 0.2
        for mask in (None, frozen):
            expected = reference.noise(rows, AMOUNT, NOW, SEED, np.zeros(count, bool) if mask is None else mask)
            found = moves(device, rows, frozen=mask)
            close(found, expected, precision_of(device), f"{count} positions")
            if mask is not None:
                assert not found[mask].any()


def test_every_step_seed_and_row_draws_other_numbers(float_device):
    rows = {name: np.repeat(values[:1], 200, axis=0) for name, values in some_rows(1).items()}
    rows["opacity_logits"][:] = -9
    first = moves(float_device, rows)
    assert len(np.unique(first, axis=0)) == 200
    for other in ({"now": NOW + 1}, {"seed": SEED + 1}):
        assert (moves(float_device, rows, **other) != first).any(axis=1).all()
    assert np.array_equal(moves(float_device, rows, seed=SEED + SEEDS), first)
    few = {name: values[:50] for name, values in rows.items()}
    assert np.array_equal(moves(float_device, few), first[:50])


@pytest.mark.parametrize("name, slot", [("log_scales", (1,)), ("quaternions", (2,)), ("opacity_logits", ())])
def test_poison_moves_nothing_to_where_it_is_not_finite(float_device, name, slot):
    rows = some_rows(40)
    rows["opacity_logits"][POISONED] = -9
    clean = moves(float_device, rows)
    others = np.arange(40) != POISONED
    for label, value in cases.POISON.items():
        found = moves(float_device, cases.poisoned(rows, name, (POISONED, *slot), value))
        assert np.isfinite(found).all(), f"{name} = {label}"
        assert np.array_equal(found[others], clean[others]), f"{name} = {label}"


def test_a_failed_frame_moves_nothing(float_device):
    failed = np.zeros(FRAME_COUNTS, np.uint32)
    failed[COUNT_FAILED] = 1
    assert not moves(float_device, some_rows(90), counts=float_device.upload(failed)).any()
