"""The scene frequency, a measure of how fine the detail of a model is (cl/frequency.cl)."""

from clsplat.constants import FREQUENCY_SUMS, FREQUENCY_TERMS, LANES
from clsplat.device import Array, Device, Forms, Kernel, groups, items
from clsplat.device.kernel import Argument
from clsplat.primitives.reduce import sum_columns

VARIANTS = ("paper", "release", "robust")
AXES = ("mean", "max", "min")  # of 1 / sigma over a gaussian's three axes
ROWS_AN_ITEM = 128  # few, so that sums stay exact enough in single precision
TOGETHER = Forms(item=1, group=LANES)  # work-items, so that sums do not depend on group size

_ROWS: dict[str, Argument] = dict(count="uint", log_scales=("real", "N", 3), opacity_logits=("real", "N"))
_MAXIMA = dict(maxima=("real", FREQUENCY_TERMS))
_ITEMS = Forms(item=items("P"), group=items("P", "SCAN_GROUP"))
LARGEST = Kernel("frequency.cl", "frequency_largest", _ITEMS, **_ROWS, partials=("real", "P", FREQUENCY_TERMS))
MAXIMA = Kernel(
    "frequency.cl",
    "max_columns",
    groups("FREQUENCY_TERMS", "SCAN_GROUP"),
    count="uint",
    partials=("real", "P", FREQUENCY_TERMS),
    **_MAXIMA,
)
PARTIALS = Kernel("frequency.cl", "frequency_sums", _ITEMS, **_ROWS, **_MAXIMA, partials=("real", "P", FREQUENCY_SUMS))
VALUES = Kernel(
    "frequency.cl",
    "frequency_values",
    items("1"),
    **_MAXIMA,
    sums=("real", FREQUENCY_SUMS),
    values=("real", len(VARIANTS), len(AXES)),
)


def scene_frequency(device: Device, rows: dict[str, Array], unit: float = 1.0) -> dict[str, float]:
    """Compute nine scene frequencies, {"paper_mean": float, ...}, in 1 / world unit; waits.
    `unit` is the world units per unit of the rows.

    Keys are a variant and an axis. Variants: `paper`, weighted by squared opacity and determinant
    (SIG, ICLR 2026); `release`, one over the mean sigma, as its released code; `robust`, ours, one
    over the mean sigma weighted by opacity, so that invisible gaussians do not count. Axis: a
    gaussian's frequency is the mean, max or min of 1 / sigma.

    Gaussians with a value that is not finite, or with a sigma or inverse that overflows single
    precision, are left out; if none remains, all values are nan.
    """
    count = len(rows["opacity_logits"])
    together = TOGETHER.of(device)
    work_items = (count // (ROWS_AN_ITEM * together) + 1) * together
    fields = dict(count=count, log_scales=rows["log_scales"], opacity_logits=rows["opacity_logits"])
    largest, partials = (device.empty((work_items, columns)) for columns in (FREQUENCY_TERMS, FREQUENCY_SUMS))
    maxima, values = device.empty(FREQUENCY_TERMS), device.empty((len(VARIANTS), len(AXES)))
    device.launch(LARGEST, **fields, partials=largest)
    device.launch(MAXIMA, count=work_items, partials=largest, maxima=maxima)
    device.launch(PARTIALS, **fields, maxima=maxima, partials=partials)
    device.launch(VALUES, maxima=maxima, sums=sum_columns(device, partials), values=values)
    return {
        f"{variant}_{axis}": float(value) / unit
        for variant, line in zip(VARIANTS, values.download())
        for axis, value in zip(AXES, line)
    }
