"""The reference's gradients of the regularisation against differences."""

import numpy as np

from tests.checks import adjoint_agrees
from tests.reference.regularise import regularisation, regularise


def test_gradients_agree_with_differences():
    rng = np.random.default_rng(0)
    point = {"logits": rng.normal(0, 2, 30), "log_scales": rng.normal(-3, 1, (30, 3))}

    def function(point):
        return {"value": np.array(regularisation(point["logits"], point["log_scales"], 0.7, 3.0))}

    def adjoint(point, grads):
        by_logits, by_scales = regularise(point["logits"], point["log_scales"], 0.7, 3.0)
        return {"logits": by_logits * grads["value"], "log_scales": by_scales * grads["value"]}

    adjoint_agrees(function, adjoint, point)
    assert np.isclose(regularisation(np.zeros(4), np.zeros((4, 3)), 0.5, 0.25), 0.5)
