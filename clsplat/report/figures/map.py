"""A map of a partition: its points, cells and cameras from above."""

from typing import BinaryIO

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.colors import BoundaryNorm, ListedColormap
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from clsplat.partition.region import CONTENT_QUANTILES, Partition, Region, world_of
from clsplat.report.figures import own_settings
from clsplat.scene import Scene

MOST_POINTS = 60_000  # drawn
WHITE_SHARE = 0.55  # of the colours of points
MOST_LABELLED = 16  # blocks; if there are more, only their numbers are written
SIDE_POINTS = 200  # on each side of a cell in contracted space, where straight sides are curves
END_DISTANCE = 1e-3  # from the ends of contracted space, where unbounded cells end
MARGIN = 0.05  # share of the extent around everything, to which unbounded cells are drawn
WIDTH, HEIGHTS = 10, (4, 14)  # inches; the height follows the map within these limits


def write_map(file: BinaryIO, partition: Partition, scene: Scene, counts: NDArray[np.integer]
              ) -> None:
    """Write `partition_map` as PNG to a binary file."""
    with own_settings():
        partition_map(partition, scene, counts).savefig(file, format="png", dpi=110)


def partition_map(partition: Partition, scene: Scene, counts: NDArray[np.integer]) -> Figure:
    """The map of a partition, in the coordinates of `Space.map`.

    Parameters
    ----------
    counts : [B], the gaussians that each block owns, written into the cells.
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
        figure = Figure(figsize=(WIDTH, np.clip(0.9 * WIDTH * height / width, *HEIGHTS)),
                        layout="constrained")
        axes = figure.subplots()
        step = max(1, -(-len(points) // MOST_POINTS))
        x, y = partition.space.map(points[::step]).T
        axes.scatter(x, y, s=3, linewidths=0, rasterized=True, zorder=1,
                     c=WHITE_SHARE + (1 - WHITE_SHARE) * scene.colours[::step] / 255)
        axes.add_collection(PolyCollection(
            rings, facecolors="none", edgecolors="#1d1f21",
            linewidths=1.3, zorder=3))
        for block in np.unique(owner[owner >= 0]):
            few = len(rings) <= MOST_LABELLED
            axes.annotate(
                f"{block}" + few * f"\n{counts[block]:,} gaussians\n{views[block]} views",
                tuple(np.median(partition.space.map(points[owner == block]), axis=0)), ha="center",
                va="center", fontsize=9, fontweight="bold", zorder=5,
                path_effects=[withStroke(linewidth=3, foreground="white")])
        _draw_cameras(figure, axes, partition, scene)
        axes.set(xlim=(left - 0.02 * width, right + 0.02 * width), aspect="equal",
                 ylim=(low - 0.02 * height, high + 0.02 * height),
                 xlabel="x of the map, world units", ylabel="y of the map, world units")
        axes.set_title(f"{scene.name}: {len(views)} blocks by {partition.method}, a view in "
                       f"{mean:.1f} of them{dropped}")
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
    dots = axes.scatter(x[shown], y[shown], s=26, c=blocks[shown], cmap=colours, zorder=4,
                        norm=BoundaryNorm(np.arange(most + 1) + 0.5, most), edgecolors="#1d1f21",
                        linewidths=0.6)
    figure.colorbar(dots, ax=axes, label="blocks with a camera's view", shrink=0.6,
                    ticks=MaxNLocator(8, integer=True, min_n_ticks=1))
    for kind, marker, colour in (("in no block", "x", "#d55e00"), ("held out", "+", "#8b9095")):
        chosen = [index for index in np.flatnonzero(~shown)
                  if (index in partition.dropped) == (kind == "in no block")]
        if chosen:
            axes.plot(x[chosen], y[chosen], marker, color=colour, markersize=9, markeredgewidth=2,
                      label=kind, zorder=4)
            axes.legend(loc="upper left", frameon=True, framealpha=0.9)


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


def _outline(region: Region, low: NDArray[np.float64], high: NDArray[np.float64]
            ) -> NDArray[np.float64]:
    """The corners [K, 2] on the map of a Region's outline at the height of its space's origin, with
    what lies beyond `low` [2] and `high` [2] along u and v moved there."""
    space = region.space
    middle = 0.5 if space.contracted else 0.0
    ends = (END_DISTANCE, 1 - END_DISTANCE) if space.contracted else (
        low / space.half[:2], high / space.half[:2])
    (left, lower), (right, upper) = (np.clip(end[:2], *ends) for end in (region.low, region.high))
    corners = np.array([(left, lower), (right, lower), (right, upper), (left, upper)])
    step = np.linspace(0, 1, SIDE_POINTS)[:, None]
    ring = np.concatenate([a + step * (b - a) for a, b in zip(corners, np.roll(corners, -1, 0))])
    world = space.world(np.column_stack([ring, np.full(len(ring), middle)]))
    along = np.clip((world - space.origin) @ space.rotation[:2].T, low, high)
    return space.map(space.origin + along @ space.rotation[:2])
