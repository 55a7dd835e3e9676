"""L1 regularisation of opacities and sizes against the reference."""

import numpy as np
import pytest

from clsplat.constants import NO_ROW
from clsplat.loss.regularise import regularise
from clsplat.primitives.compact import new_counts
from clsplat.rendering.project import Gradients
from tests.checks import close
from tests.kernels.chain import precision_of
from tests.reference import regularise as reference

WEIGHTS = 0.01, 0.03


@pytest.mark.double
@pytest.mark.oclgrind
@pytest.mark.parametrize("spare", [0, 20])
def test_against_the_reference(device, spare):
    """It adds to the gradients that exist and are not marked."""
    rng, group = np.random.default_rng(0), device.group_size
    for seen in (0, 1, group - 1, group, group + 1, 3 * group + 7):
        count, slots = 2 * seen + spare + 3, max(seen + spare, 1)
        logits = rng.normal(0, 3, count).astype(np.float32)
        log_scales = rng.normal(-3, 1, (count, 3)).astype(np.float32)
        visible = np.sort(rng.permutation(count)[:slots]).astype(np.uint32)
        marked = rng.random(slots) < 0.2
        rows = np.where(marked, NO_ROW, visible).astype(np.uint32)
        before = {"opacity_logits": np.zeros(slots), "log_scales": np.zeros((slots, 3))}
        gradients = Gradients(
            {name: device.upload(values) for name, values in before.items()},
            None,
            device.upload(rows),
            device.upload(visible),
            new_counts(device, seen),
        )
        expected = (
            reference.regularise(
                logits[visible[:seen]].astype(np.float64), log_scales[visible[:seen]].astype(np.float64), *WEIGHTS
            )
            if seen
            else ((), ())
        )
        for times in (1, 2):
            regularise(
                {"opacity_logits": device.upload(logits), "log_scales": device.upload(log_scales)}, gradients, *WEIGHTS
            )
            for name, of_seen in zip(before, expected):
                grads = before[name].copy()
                grads[:seen] = times * np.asarray(of_seen).reshape(grads[:seen].shape)
                grads[marked] = 0
                close(gradients.fields[name].download(), grads, precision_of(device), f"{name} of {seen}")
