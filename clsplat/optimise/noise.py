"""Random steps of the positions of nearly transparent gaussians (cl/noise.cl)."""

from collections.abc import Mapping

from clsplat.constants import FRAME_COUNTS
from clsplat.device import Array, Kernel, each

SEEDS = 2**32
NOISE = Kernel(
    "noise.cl",
    "noise",
    each("count"),
    count="uint",
    seed="uint",
    now="uint",
    amount="real",
    has_frozen="uint",
    counts=("uint", FRAME_COUNTS),
    frozen=("uint", "F"),
    log_scales=("real", "N", 3),
    quaternions=("real", "N", 4),
    opacity_logits=("real", "N"),
    positions=("real", "N", 3),
)


def add_noise(
    rows: Mapping[str, Array], amount: float, now: int, seed: int, counts: Array, frozen: Array | None = None
) -> None:
    """Move positions at random in place, unless their frame has failed (`counts`).

    Each row moves, whether or not it lags behind the last step (adam.py): a random step and the
    steps that a row has missed add up in any order. Rows that are not 0 in `frozen`, uint[N], stay.
    `amount`, 1 / world unit, is the factor of the covariance: the paper's noise rate times the
    learning rate of the positions. Seeds that differ by a multiple of SEEDS draw the same numbers.
    """
    positions = rows["positions"]
    positions.device.launch(
        NOISE,
        count=len(positions),
        seed=seed % SEEDS,
        now=now,
        amount=amount,
        has_frozen=int(frozen is not None),
        counts=counts,
        frozen=counts if frozen is None else frozen,
        log_scales=rows["log_scales"],
        quaternions=rows["quaternions"],
        opacity_logits=rows["opacity_logits"],
        positions=positions,
    )
