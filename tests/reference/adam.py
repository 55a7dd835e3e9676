"""One step of Adam (Kingma and Ba 2015) on some rows, with bias correction."""

import numpy as np


def adam(parameters, grads, first, second, step, rate, rows=None, betas=(0.9, 0.999), epsilon=1e-15):
    """New (parameters, first moment, second moment), all [N, ...]; step counts from 1.

    rows: indices or mask of the rows to change (None: all); the others keep value and moments.
    """
    rows = slice(None) if rows is None else rows
    parameters, first, second = parameters.copy(), first.copy(), second.copy()
    g = grads[rows]
    first[rows] = betas[0] * first[rows] + (1 - betas[0]) * g
    second[rows] = betas[1] * second[rows] + (1 - betas[1]) * g**2
    first_hat = first[rows] / (1 - betas[0] ** step)
    second_hat = second[rows] / (1 - betas[1] ** step)
    parameters[rows] -= rate * first_hat / (np.sqrt(second_hat) + epsilon)
    return parameters, first, second


def noise_of(element, now):
    """The random bits uint32 of elements uint32 in a step (cl/include/moments.h)."""
    with np.errstate(over="ignore"):
        h = element * np.uint32(0x9E3779B1) + np.uint32(now) * np.uint32(0x85EBCA77)
        h = (h ^ (h >> np.uint32(15))) * np.uint32(0x2C1B3C6D)
        h = (h ^ (h >> np.uint32(12))) * np.uint32(0x297A2D39)
    return h ^ (h >> np.uint32(15))


def coded_step(moments, grads, step, names):
    """(m, v) by field after a step in which all rows had gradients, as CodedAdam rounds them.

    moments: (m, v) before; names: the fields in the order of their columns, sh_rest among them."""
    rounded = {}, {}
    small = [name for name in names if name != "sh_rest"]
    widths = {name: int(np.prod(grads[name].shape[1:], initial=1)) for name in names}
    first_column = dict(zip((*small, "sh_rest"), np.cumsum([0, *(widths[name] for name in small)])))
    for name in names:
        count, width = len(grads[name]), widths[name]
        element = (
            np.arange(count, dtype=np.uint32)[:, None] * np.uint32(sum(widths.values()))
            + np.arange(width, dtype=np.uint32)
            + np.uint32(first_column[name])
        )
        noise = noise_of(element, step).reshape(grads[name].shape)
        m = moments[0][name] + 0.1 * (grads[name] - moments[0][name])
        v = moments[1][name] + 0.001 * (grads[name] ** 2 - moments[1][name])
        m, v = (values.astype(np.float32).view(np.uint32).astype(np.uint64) for values in (m, v))
        m, v = (m + (noise >> 12)) >> 20 << 20, (v + (noise & ((1 << 19) - 1))) >> 19 << 19
        for moments_of, values in zip(rounded, (m, v)):
            moments_of[name] = values.astype(np.uint32).view(np.float32)
    return rounded
