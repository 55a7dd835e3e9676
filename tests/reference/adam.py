"""One step of Adam (Kingma and Ba 2015) on some rows, with bias correction."""

import numpy as np


def adam(parameters, grads, first, second, step, rate, rows=None,
         betas=(0.9, 0.999), epsilon=1e-15):
    """New (parameters, first moment, second moment), all [N, ...]; step counts from 1.

    rows: indices or mask of the rows to change (None: all); the others keep value and moments.
    """
    rows = slice(None) if rows is None else rows
    parameters, first, second = parameters.copy(), first.copy(), second.copy()
    g = grads[rows]
    first[rows] = betas[0] * first[rows] + (1 - betas[0]) * g
    second[rows] = betas[1] * second[rows] + (1 - betas[1]) * g**2
    first_hat = first[rows] / (1 - betas[0]**step)
    second_hat = second[rows] / (1 - betas[1]**step)
    parameters[rows] -= rate * first_hat / (np.sqrt(second_hat) + epsilon)
    return parameters, first, second
