"""How fine the detail is that a model holds: its scene frequency (cl/frequency.cl)."""

from clsplat.device import Array, Device, Kernel
from clsplat.primitives.reduce import sum_columns

VARIANTS = ("paper", "release", "robust")
AXES = ("mean", "max", "min")  # over a gaussian's three axes, of 1 / sigma
ROWS_AN_ITEM = 128  # few, so that single precision can add them up
LARGEST_GROUP = 256  # whose items come together, whatever the group: the same sums of each
TERMS, SUMS = 11, 12  # columns; frequency.cl has the same

_ROWS = dict(count="uint", log_scales=("real", "N", 3), opacity_logits=("real", "N"))
LARGEST = Kernel("frequency.cl", "frequency_largest", **_ROWS, partials=("real", "P", TERMS))
MAXIMA = Kernel("frequency.cl", "max_columns", count="uint", partials=("real", "P", TERMS),
                maxima=("real", TERMS))
PARTIALS = Kernel("frequency.cl", "frequency_sums", **_ROWS, maxima=("real", TERMS),
                  partials=("real", "P", SUMS))
VALUES = Kernel("frequency.cl", "frequency_values", maxima=("real", TERMS), sums=("real", SUMS),
                values=("real", len(VARIANTS), len(AXES)))


def scene_frequency(device: Device, rows: dict[str, Array],
                    unit: float = 1.0) -> dict[str, float]:
    """{"paper_mean": float, ...}: nine scene frequencies, in 1 / world unit; waits.

    Parameters
    ----------
    device : of the rows.
    rows : field name -> Array, of which log_scales real[N, 3] and opacity_logits real[N] are read.
    unit : world units that one of theirs stands for.

    Notes
    -----
    Keys are a variant and an axis. Variants: `paper`, weighted by squared opacity and determinant
    (SIG, ICLR 2026); `release`, one over the mean sigma, as its released code; `robust`, ours, one
    over the mean sigma weighted by opacity, so that what cannot be seen does not count. Axis: what
    a gaussian's frequency is, the mean, max or min of 1 / sigma.

    Gaussians do not count that have a number that is not finite, or a sigma or its inverse that
    single precision cannot hold; where none counts, all values are nan.
    """
    count = len(rows["opacity_logits"])
    lanes = device.scan_group
    group, together = (1, 1) if device.form == "item" else (lanes, LARGEST_GROUP)
    items = (count // (ROWS_AN_ITEM * together) + 1) * together
    defines = (("GROUP", lanes),)
    fields = dict(count=count, log_scales=rows["log_scales"],
                  opacity_logits=rows["opacity_logits"])
    largest, partials = device.empty((items, TERMS)), device.empty((items, SUMS))
    maxima, values = device.empty(TERMS), device.empty((len(VARIANTS), len(AXES)))
    device.launch(LARGEST, items, group, defines, **fields, partials=largest)
    device.launch(MAXIMA, TERMS * lanes, lanes, defines, count=items, partials=largest,
                  maxima=maxima)
    device.launch(PARTIALS, items, group, defines, **fields, maxima=maxima, partials=partials)
    device.launch(VALUES, 1, 1, defines, maxima=maxima, sums=sum_columns(device, partials),
                  values=values)
    return {f"{variant}_{axis}": float(value) / unit
            for variant, line in zip(VARIANTS, values.download())
            for axis, value in zip(AXES, line)}
