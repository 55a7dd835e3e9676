"""Scene frequency: as the SIG paper (ICLR 2026) defines it, as its code computes it, and ours.

Written as defined, without logarithms: sizes of e^-87 to e^87 to the sixth power fit into float64.
"""

import numpy as np

LARGEST_LOG = 87  # beyond, float32 holds sigma or 1 / sigma no more: such a row does not count


def scene_frequency(log_scales, opacity_logits):
    """{variant_axis: float} of [N, 3] and [N], in 1 / world unit; nan where no row counts."""
    counts = np.isfinite(opacity_logits) & (np.abs(log_scales) <= LARGEST_LOG).all(axis=1)
    if not counts.any():
        return {
            f"{variant}_{axis}": np.nan for variant in ("paper", "release", "robust") for axis in ("mean", "max", "min")
        }
    sigma = np.exp(log_scales[counts])
    opacity = np.exp(-np.logaddexp(0, -opacity_logits[counts]))
    paper = opacity**2 * sigma.prod(axis=1) ** 2
    result = {}
    for axis, omega, averaged in (
        ("mean", (1 / sigma).mean(axis=1), sigma.mean(axis=1)),
        ("max", (1 / sigma).max(axis=1), sigma.min(axis=1)),
        ("min", (1 / sigma).min(axis=1), sigma.max(axis=1)),
    ):
        result[f"paper_{axis}"] = (paper * omega).sum() / paper.sum()
        result[f"release_{axis}"] = 1 / averaged.mean()
        result[f"robust_{axis}"] = opacity.sum() / (opacity * averaged).sum()
    return result
