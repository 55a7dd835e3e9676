"""The map of a partition: what is drawn is where it is, and says what it should."""

from dataclasses import replace

import numpy as np
import pytest
from matplotlib.collections import PathCollection, PolyCollection

from clsplat.cities.seams import find_borders
from clsplat.partition.options import METHODS
from clsplat.report.figures.map import partition_map
from tests.data.fields import cut, field, moved, world


def drawn(method="blockgs", grid=(3, 2), counts=range(6), cameras=30, blind=None):
    scene = moved(field(cameras=cameras), np.eye(3), 2.0, np.array([500.0, 40.0, 7.0]))
    seen = scene.observations[:, 1] != blind
    scene = replace(scene, observations=scene.observations[seen])
    partition = cut(scene, method, grid, views=np.arange(1, cameras))
    return scene, partition, partition_map(partition, scene, counts)


@pytest.mark.parametrize("method", METHODS)
def test_cells_points_and_cameras_are_where_they_are(method):
    scene, partition, figure = drawn(method)
    axes = figure.axes[0]
    (cells,) = (c for c in axes.collections if isinstance(c, PolyCollection))
    points, cameras = (c for c in axes.collections if isinstance(c, PathCollection))
    assert len(cells.get_paths()) == 6
    owner = partition.owner(world(scene))
    places = np.asarray(points.get_offsets())
    for block, path in enumerate(cells.get_paths()):
        assert (path.contains_points(places) <= (owner == block)).mean() > 0.999
        assert path.contains_points(places[owner == block]).mean() > 0.97  # but those far off
    taken = sorted(set(np.concatenate(partition.views).tolist()))
    positions = np.array([scene.views[index].camera.position for index in taken])
    positions = scene.offset + scene.unit * positions
    assert np.allclose(cameras.get_offsets(), partition.space.map(positions))
    blocks = np.bincount(np.concatenate(partition.views), minlength=30)
    assert np.array_equal(cameras.get_array(), blocks[taken])
    assert axes.get_aspect() == 1


def test_labels_name_block_gaussians_and_views():
    _, partition, figure = drawn(counts=np.arange(1000, 1006))
    texts = [text.get_text().split("\n") for text in figure.axes[0].texts]
    assert texts == [
        [str(block), f"{1000 + block:,} gaussians", f"{len(views)} views"]
        for block, views in enumerate(partition.views)
    ]


def test_held_out_and_lost_views_are_marked_apart():
    _, partition, figure = drawn(blind=7)
    assert list(partition.dropped) == [7]
    marks = {line.get_label(): len(line.get_xdata()) for line in figure.axes[0].lines}
    assert marks == {"in no block": 1, "held out": 1}
    assert ", 1 in none" in figure.axes[0].get_title(loc="left")


def test_borders_are_drawn_with_their_seams():
    scene, partition, plain = drawn()
    found = [
        {"blocks": border.blocks, "seam_db": 0.5 if border.blocks[0] else None} for border in find_borders(partition)
    ]
    figure = partition_map(partition, scene, range(6), found)
    lines = [line for line in figure.axes[0].lines if line not in plain.axes[0].lines and len(line.get_xdata()) > 20]
    seams = [text for text in figure.axes[0].texts if text.get_text() == "0.5 dB"]
    assert len(lines) == len(seams) == sum(border["seam_db"] is not None for border in found) > 2
    for border, line in zip((each for each in found if each["seam_db"]), lines):
        one, other = (partition.regions[block].grown(1e-6) for block in border["blocks"])
        origin = partition.space.origin
        away = np.transpose(line.get_data()) - partition.space.map(origin[None])
        places = origin + np.column_stack([away, np.zeros(len(away))])
        assert one.owns(places).all() and other.owns(places).all()
