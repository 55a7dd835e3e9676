"""A map of a partition: its points, cells and cameras from above, and the seams of its model."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, BinaryIO

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.colors import BoundaryNorm, ListedColormap
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from clsplat.partition.region import CONTENT_QUANTILES, Partition, Region, Space, world_of
from clsplat.report.figures import own_settings
from clsplat.scene import Scene

MOST_POINTS = 60_000  # drawn
WHITE_SHARE = 0.55  # of the colours of points
MOST_LABELLED = 16  # blocks; if there are more, only their numbers are written
SIDE_POINTS = 200  # on each side of a cell in contracted space, where straight sides are curves
END_DISTANCE = 1e-3  # from the ends of contracted space, where unbounded cells end
MARGIN = 0.05  # share of the extent around everything, to which unbounded cells are drawn
VISIBLE_SEAM = 0.2  # dB
WIDTH, HEIGHTS = 10, (4, 14)  # inches; the height follows the map within these limits


def write_map(
    file: BinaryIO, partition: Partition, scene: Scene, counts: Sequence[int], borders: Iterable[Mapping[str, Any]] = ()
) -> None:
    """Write `partition_map` as PNG to a binary file."""
    with own_settings():
        partition_map(partition, scene, counts, borders).savefig(file, format="png", dpi=110)


def partition_map(
    partition: Partition, scene: Scene, counts: Sequence[int], borders: Iterable[Mapping[str, Any]] = ()
) -> Figure:
    """The map of a partition, in the coordinates of `Space.map`.

    Parameters
    ----------
    counts : [B], the gaussians that each block owns, written into the cells.
    borders : of the merged model, from `cities.seams.find_seams`, drawn with their seams.
    """
    points = world_of(scene, scene.points)
    owner = partition.owner(points)
    ends = _extent(partition, scene)
    rings = [_outline(region, *ends) for region in partition.regions]
    corners = np.concatenate(rings)
    width, height = np.ptp(corners, axis=0)
    (left, low), (right, high) = corners.min(axis=0), corners.max(axis=0)
    views = [len(views) for views in partition.views]
    mean = sum(views) / max(1, len(np.unique(np.concatenate(partition.views))))
    dropped = f", {len(partition.dropped)} in none" if partition.dropped else ""
    with own_settings():
        figure = Figure(figsize=(WIDTH, np.clip(0.9 * WIDTH * height / width, *HEIGHTS)), layout="constrained")
        axes = figure.subplots()
        step = max(1, -(-len(points) // MOST_POINTS))
        x, y = partition.space.map(points[::step]).T
        axes.scatter(
            x,
            y,
            s=3,
            linewidths=0,
            rasterized=True,
            zorder=1,
            c=WHITE_SHARE + (1 - WHITE_SHARE) * scene.colours[::step] / 255,
        )
        axes.add_collection(PolyCollection(rings, facecolors="none", edgecolors="#1d1f21", linewidths=1.3, zorder=3))
        for block in np.unique(owner[owner >= 0]):
            few = len(rings) <= MOST_LABELLED
            axes.annotate(
                f"{block}" + few * f"\n{counts[block]:,} gaussians\n{views[block]} views",
                tuple(np.median(partition.space.map(points[owner == block]), axis=0)),
                ha="center",
                va="center",
                fontsize=9,
                fontweight="bold",
                zorder=5,
                path_effects=[withStroke(linewidth=3, foreground="white")],
            )
        _draw_cameras(figure, axes, partition, scene)
        _draw_seams(axes, partition, borders, ends)
        axes.set(
            xlim=(left - 0.02 * width, right + 0.02 * width),
            aspect="equal",
            ylim=(low - 0.02 * height, high + 0.02 * height),
            xlabel="x of the map, world units",
            ylabel="y of the map, world units",
        )
        axes.set_title(
            f"{scene.name}: {len(views)} blocks by {partition.method}, a view in {mean:.1f} of them{dropped}"
        )
    return figure


def _draw_cameras(figure: Figure, axes: Axes, partition: Partition, scene: Scene) -> None:
    """Draw a dot for each camera, coloured by the number of blocks with its view.

    Views in no block have a cross.
    """
    blocks = np.zeros(len(scene.views), int)
    for views in partition.views:
        blocks[views] += 1
    x, y = partition.space.map(world_of(scene, [v.camera.position for v in scene.views])).T
    shown = blocks > 0
    most = max(1, blocks.max())
    colours = ListedColormap(matplotlib.colormaps["viridis"](np.linspace(0.1, 1, most)))
    dots = axes.scatter(
        x[shown],
        y[shown],
        s=26,
        c=blocks[shown],
        cmap=colours,
        zorder=4,
        norm=BoundaryNorm(np.arange(most + 1) + 0.5, most),
        edgecolors="#1d1f21",
        linewidths=0.6,
    )
    figure.colorbar(
        dots,
        ax=axes,
        label="blocks with a camera's view",
        shrink=0.6,
        ticks=MaxNLocator(8, integer=True, min_n_ticks=1),
    )
    for kind, marker, colour in (("in no block", "x", "#d55e00"), ("held out", "+", "#8b9095")):
        chosen = [index for index in np.flatnonzero(~shown) if (index in partition.dropped) == (kind == "in no block")]
        if chosen:
            axes.plot(x[chosen], y[chosen], marker, color=colour, markersize=9, markeredgewidth=2, label=kind, zorder=4)
            axes.legend(loc="upper left", frameon=True, framealpha=0.9)


def _draw_seams(
    axes: Axes,
    partition: Partition,
    borders: Iterable[Mapping[str, Any]],
    ends: tuple[NDArray[np.float64], NDArray[np.float64]],
) -> None:
    """Draw borders with their seams, wide and orange where the merged model lacks PSNR there."""
    for border in borders:
        one, other = border["blocks"]
        line = _border(partition.regions[one], partition.regions[other], *ends)
        if line is None or not len(line) or (seam := border["seam_db"]) is None:
            continue
        colour = "#d55e00" if seam > VISIBLE_SEAM else "#0072b2"
        width = float(np.clip(2 + 6 * seam, 2, 8))
        axes.plot(*line.T, color=colour, linewidth=width, solid_capstyle="butt", zorder=3.5)
        axes.annotate(
            f"{seam:.1f} dB",
            tuple(line[len(line) // 2]),
            ha="center",
            va="center",
            fontsize=9,
            fontweight="bold",
            color=colour,
            zorder=5,
            path_effects=[withStroke(linewidth=3, foreground="white")],
        )


def _extent(partition: Partition, scene: Scene) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The low [2] and high [2] end of the map along u and v, world units from the space's origin.

    The map contains all cameras, and the sparse points without outliers.
    """
    axes, origin = partition.space.rotation[:2], partition.space.origin
    points = (world_of(scene, scene.points) - origin) @ axes.T
    cameras = (world_of(scene, [v.camera.position for v in scene.views]) - origin) @ axes.T
    ends = np.concatenate([np.quantile(points, CONTENT_QUANTILES, axis=0), cameras])
    low, high = ends.min(axis=0), ends.max(axis=0)
    margin = MARGIN * max((high - low).max(), np.finfo(float).tiny)
    return low - margin, high + margin


def _outline(region: Region, low: NDArray[np.float64], high: NDArray[np.float64]) -> NDArray[np.float64]:
    """The corners [K, 2] on the map of a Region's outline, see `_on_map`."""
    (left, lower), (right, upper) = region.low[:2], region.high[:2]
    corners = np.array([(left, lower), (right, lower), (right, upper), (left, upper)])
    return _on_map(region.space, np.concatenate([corners, corners[:1]]), low, high)


def _border(
    one: Region, other: Region, low: NDArray[np.float64], high: NDArray[np.float64]
) -> NDArray[np.float64] | None:
    """The line [K, 2] on the map that two Regions share, see `_on_map`; None: they share none."""
    begin, end = np.maximum(one.low, other.low)[:2], np.minimum(one.high, other.high)[:2]
    if sorted(np.sign(end - begin)) != [0, 1]:
        return None
    return _on_map(one.space, np.array([begin, end]), low, high, beyond=False)


def _on_map(
    space: Space, corners: NDArray[np.float64], low: NDArray[np.float64], high: NDArray[np.float64], beyond: bool = True
) -> NDArray[np.float64]:
    """A line [K, 2] on the map along corners in coordinates of the space, at the height of its
    origin, with what lies beyond `low` [2] and `high` [2] along u and v moved there, or left out.
    """
    middle = 0.5 if space.contracted else 0.0
    ends = (END_DISTANCE, 1 - END_DISTANCE) if space.contracted else (low / space.half[:2], high / space.half[:2])
    corners, step = np.clip(corners, *ends), np.linspace(0, 1, SIDE_POINTS)[:, None]
    line = np.concatenate([a + step * (b - a) for a, b in zip(corners, corners[1:])])
    world = space.world(np.column_stack([line, np.full(len(line), middle)]))
    along = np.clip((world - space.origin) @ space.rotation[:2].T, low, high)
    if not beyond:
        along = along[((along > low) & (along < high)).all(axis=1)]
    return space.map(space.origin + along @ space.rotation[:2])
