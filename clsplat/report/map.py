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

from clsplat.partition.input import world_of
from clsplat.partition.outline import centroid, extent, outline
from clsplat.partition.partition import Partition
from clsplat.report.charts import COLOURS, own_settings
from clsplat.scene import Scene

MOST_POINTS = 60_000  # drawn
WHITE_SHARE = 0.55  # of the colours of points
MOST_LABELLED = 16  # blocks; if there are more, only their numbers are written
WIDTH, HEIGHTS = 10, (4, 14)  # inches; the height follows the map within these limits


def write_map(file: BinaryIO, partition: Partition, scene: Scene,
              counts: NDArray[np.integer] | None = None) -> None:
    """Write `partition_map` as PNG to a binary file."""
    with own_settings():
        partition_map(partition, scene, counts).savefig(file, format="png", dpi=110)


def partition_map(partition: Partition, scene: Scene, counts: NDArray[np.integer] | None = None
                  ) -> Figure:
    """The map of a partition, in the coordinates of `Space.map`.

    Parameters
    ----------
    counts : [B], the gaussians that each block owns, written into the cells; None: sparse points.
    """
    points = world_of(scene, scene.points)
    counted = "points" if counts is None else "gaussians"
    if counts is None:
        owner = partition.owner(points)
        counts = np.bincount(owner[owner >= 0], minlength=len(partition.regions))
    ends = extent(partition, scene)
    rings = [outline(region, *ends) for region in partition.regions]
    corners = np.concatenate(rings)
    width, height = np.ptp(corners, axis=0)
    (left, low), (right, high) = corners.min(axis=0), corners.max(axis=0)
    views = [len(views) for views in partition.views]
    mean = sum(views) / max(1, len(np.unique(np.concatenate(partition.views))))
    dropped = f", {len(partition.dropped)} in none" if partition.dropped else ""
    with own_settings(**{"axes.grid": False}):
        figure = Figure(figsize=(WIDTH, np.clip(0.9 * WIDTH * height / width, *HEIGHTS)),
                        layout="constrained")
        axes = figure.subplots()
        step = max(1, -(-len(points) // MOST_POINTS))
        x, y = partition.space.map(points[::step]).T
        axes.scatter(x, y, s=3, linewidths=0, rasterized=True, zorder=1,
                     c=WHITE_SHARE + (1 - WHITE_SHARE) * scene.colours[::step] / 255)
        axes.add_collection(PolyCollection(
            [ring for ring in rings if len(ring)], facecolors="none", edgecolors="#1d1f21",
            linewidths=1.3, zorder=3))
        for block, ring in enumerate(rings):
            if len(ring):
                few = len(rings) <= MOST_LABELLED
                axes.annotate(
                    f"{block}" + few * f"\n{counts[block]:,} {counted}\n{views[block]} views",
                    tuple(centroid(ring)), ha="center", va="center", fontsize=9, fontweight="bold",
                    zorder=5, path_effects=[withStroke(linewidth=3, foreground="white")])
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
    for kind, marker, colour in (("in no block", "x", COLOURS[1]), ("held out", "+", "#8b9095")):
        chosen = [index for index in np.flatnonzero(~shown)
                  if (index in partition.dropped) == (kind == "in no block")]
        if chosen:
            axes.plot(x[chosen], y[chosen], marker, color=colour, markersize=9, markeredgewidth=2,
                      label=kind, zorder=4)
            axes.legend(loc="upper left", frameon=True, framealpha=0.9)
