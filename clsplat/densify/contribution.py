"""What each splat contributed to a rendered frame (cl/contribution.cl)."""

from clsplat.constants import SPLAT_REALS
from clsplat.device import Forms, Kernel, each, groups, items

COLUMNS = 4  # pixels, weight, weighted image, distance

CONTRIBUTION = Kernel(
    "contribution.cl", "contribution", Forms(item=items("T"), group=groups("T", "TILE TILE")),
    width="int", height="int", tiles_x="int", first_tile="int", ranges=("uint", "T", 2),
    sorted_splats=("uint", "P"), emission_indices=("uint", "P"),
    splats=("real", "V", SPLAT_REALS), last_contributor=("int", "H", "W"),
    weights=("real", "H", "W"), sums=("real", "P", COLUMNS))
SUM = Kernel(
    "contribution.cl", "sum_contributions", each("count"), count="uint", carried="uint",
    order=("uint", "V"), counts=("uint", "V"), offsets=("uint", "V"), sums=("real", "P", COLUMNS),
    totals=("real", "V", COLUMNS))


def contribution(device, frame, weights):
    """real[V, 4] in the order of `frame.visible`, summed over the pixels where a splat was blended:
    their number, alpha T, alpha T times the weight, and the distance from the splat's mean, pixels.

    frame: `render.pipeline.Frame`; weights: real[H, W], an image of its size.
    """
    totals = None
    for band in frame.bands:
        totals = _add_band(device, frame, frame.pairs_of(band), weights, totals)
    return totals


def _add_band(device, frame, pairs, weights, totals):
    width, height = frame.size
    splats = frame.splats
    sums = device.empty((pairs.count, COLUMNS))
    device.launch(CONTRIBUTION, width=width, height=height, tiles_x=pairs.tiles_x,
                  first_tile=pairs.tiles.start, ranges=pairs.ranges,
                  sorted_splats=pairs.sorted_splats, emission_indices=pairs.emission_indices,
                  splats=splats, last_contributor=frame.blended.last_contributor, weights=weights,
                  sums=sums)
    carried = totals is not None
    if not carried:
        totals = device.empty((len(splats), COLUMNS))
    device.launch(SUM, count=len(splats), carried=carried, order=pairs.order, counts=pairs.counts,
                  offsets=pairs.offsets, sums=sums, totals=totals)
    return totals
