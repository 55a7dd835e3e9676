"""A map of a partition, for a person to judge: points, cells and cameras from above."""

import matplotlib
import numpy as np
from matplotlib.collections import PolyCollection
from matplotlib.colors import BoundaryNorm, ListedColormap
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke
from matplotlib.ticker import MaxNLocator

from clsplat.partition.input import world_of
from clsplat.partition.outline import centroid, extent, outline
from clsplat.report.drawing import clean_look
from clsplat.report.figures import COLOURS

POINTS = 60_000  # drawn
PALE = 0.55  # share of white in their colours
LABELLED = 16  # blocks; of more, only the numbers are written
WIDTH, HEIGHT = 10, (4, 14)  # inches; the height follows the map within these


def write_map(file, partition, scene, counts=None):
    """Write `partition_map` as PNG to a binary file."""
    with clean_look():
        partition_map(partition, scene, counts).savefig(file, format="png", dpi=110)


def partition_map(partition, scene, counts=None):
    """The Figure of a Partition of a Scene; counts: int[B], gaussians a block owns (None: sparse
    points), written into the cells. Coordinates are those of `Space.map`."""
    points = world_of(scene, scene.points)
    what = "points" if counts is None else "gaussians"
    if counts is None:
        owner = partition.owner(points)
        counts = np.bincount(owner[owner >= 0], minlength=len(partition.regions))
    ends = extent(partition, scene)
    rings = [outline(region, *ends) for region in partition.regions]
    corners = np.concatenate(rings)
    wide, high = np.ptp(corners, axis=0)
    with clean_look(**{"axes.grid": False}):
        figure = Figure(figsize=(WIDTH, np.clip(0.9 * WIDTH * high / wide, *HEIGHT)),
                        layout="constrained")
        axes = figure.subplots()
        _draw_points(axes, partition, scene, points)
        axes.add_collection(PolyCollection(
            [ring for ring in rings if len(ring)], facecolors="none", edgecolors="#1d1f21",
            linewidths=1.3, zorder=3))
        for block, ring in enumerate(rings):
            if len(ring):
                _label(axes, block, ring, partition, counts, what)
        _draw_cameras(figure, axes, partition, scene)
        axes.set_xlim(*_ends(corners[:, 0]))
        axes.set_ylim(*_ends(corners[:, 1]))
        axes.set_aspect("equal")
        axes.set_xlabel("x of the map, world units")
        axes.set_ylabel("y of the map, world units")
        axes.set_title(_title(partition, scene))
    return figure


def _title(partition, scene):
    taken = [len(views) for views in partition.views]
    each = sum(taken) / max(1, len(np.unique(np.concatenate(partition.views))))
    lost = f", {len(partition.dropped)} in none" if partition.dropped else ""
    return (f"{scene.name}: {len(taken)} blocks by {partition.method}, a view in {each:.1f} of "
            f"them{lost}")


def _ends(values):
    room = 0.02 * np.ptp(values)
    return values.min() - room, values.max() + room


def _draw_points(axes, partition, scene, points):
    step = max(1, -(-len(points) // POINTS))
    x, y = partition.space.map(points[::step]).T
    colours = PALE + (1 - PALE) * scene.colours[::step] / 255
    axes.scatter(x, y, s=3, c=colours, linewidths=0, rasterized=True, zorder=1)


def _label(axes, block, ring, partition, counts, what):
    lines = [str(block)]
    if len(partition.regions) <= LABELLED:
        lines += [f"{counts[block]:,} {what}", f"{len(partition.views[block])} views"]
    axes.annotate("\n".join(lines), centroid(ring), ha="center", va="center", fontsize=9,
                  fontweight="bold", zorder=5,
                  path_effects=[withStroke(linewidth=3, foreground="white")])


def _draw_cameras(figure, axes, partition, scene):
    """A dot a camera, coloured by how many blocks take its view; dropped ones are crossed out."""
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
    figure.colorbar(dots, ax=axes, label="blocks that take a camera's view", shrink=0.6,
                    ticks=MaxNLocator(8, integer=True, min_n_ticks=1))
    for kind, marker, colour in (("in no block", "x", COLOURS[1]), ("held out", "+", "#8b9095")):
        of = [index for index in np.flatnonzero(~shown)
              if (index in partition.dropped) == (kind == "in no block")]
        if of:
            axes.plot(x[of], y[of], marker, color=colour, markersize=9, markeredgewidth=2,
                      label=kind, zorder=4)
            axes.legend(loc="upper left", frameon=True, framealpha=0.9)
