"""What each splat contributed to a rendered frame (cl/contribution.cl)."""

from clsplat.constants import FRAME_COUNTS, SPLAT_REALS
from clsplat.device import Array, Device, Forms, Kernel, each, groups, items
from clsplat.rendering.pipeline import Frame

COLUMNS = 4  # pixels, weight, weighted image, distance

CONTRIBUTION = Kernel(
    "contribution.cl",
    "contribution",
    Forms(item=items("T"), group=groups("T", "TILE TILE")),
    width="int",
    height="int",
    tiles_x="int",
    first_tile="int",
    ranges=("uint", "T", 2),
    sorted_splats=("uint", "P"),
    emission_indices=("uint", "P"),
    splats=("real", "V", SPLAT_REALS),
    last_contributor=("int", "H", "W"),
    weights=("real", "H", "W"),
    sums=("real", "P", COLUMNS),
)
SUM = Kernel(
    "contribution.cl",
    "sum_contributions",
    each("V"),
    carried="uint",
    counts=("uint", FRAME_COUNTS),
    splat_counts=("uint", "V"),
    offsets=("uint", "V"),
    sums=("real", "P", COLUMNS),
    totals=("real", "V", COLUMNS),
)


def contribution(device: Device, frame: Frame, weights: Array) -> Array:
    """What each splat contributed to a frame, summed over the pixels where it was blended.

    Parameters
    ----------
    frame : a rendered view.
    weights : real[H, W], the weights of its pixels.

    Returns
    -------
    real[V, 4], in the order of `frame.visible`, of which the first counts[COUNT_VISIBLE] exist: the
    number of pixels, alpha T, alpha T times the weight, and the distance from the splat's mean in
    pixels.
    """
    width, height = frame.size
    totals = device.empty((len(frame.splats), COLUMNS))
    for number, band in enumerate(frame.bands):
        pairs = frame.pairs_of(band)
        sums = device.empty((pairs.count, COLUMNS))
        device.launch(
            CONTRIBUTION,
            width=width,
            height=height,
            tiles_x=pairs.tiles_x,
            first_tile=pairs.tiles.start,
            ranges=pairs.ranges,
            sorted_splats=pairs.sorted_splats,
            emission_indices=pairs.emission_indices,
            splats=frame.splats,
            last_contributor=frame.blended.last_contributor,
            weights=weights,
            sums=sums,
        )
        device.launch(
            SUM,
            carried=number > 0,
            counts=pairs.counts,
            splat_counts=pairs.splat_counts,
            offsets=pairs.offsets,
            sums=sums,
            totals=totals,
        )
    return totals
