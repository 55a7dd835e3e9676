"""Trees of levels of detail: every gaussian in one leaf, every view by the nodes that it needs."""

import numpy as np
import pytest

from clsplat.camera import Camera
from clsplat.edit.select import mean_sigma, parted
from clsplat.gaussians import LEARNED, Gaussians
from clsplat.io.models.tree import HEADER, NO_PARENT, ORDER, Tree, writing_tree
from clsplat.rendering.tree import choose
from tests.data.made_tree import write_tree
from tests.refusals import refused

CELL, COUNT = 40, 1000
LENGTH = 100.0  # of the strip


def strip(count, sigma, seed=0, degree=1):
    """Gaussians, all of one sigma, along x from 0 to LENGTH and about 1 thick."""
    rng = np.random.default_rng([seed, count])
    rows = {f.name: rng.normal(size=(count, *f.row_shape(degree))).astype(np.float32) for f in LEARNED}
    rows["positions"] = rng.uniform((0, 0, 0), (LENGTH, 1, 1), (count, 3)).astype(np.float32)
    rows["log_scales"] = np.full((count, 3), np.log(sigma), np.float32)
    return Gaussians(rows, degree)


def at(x, focal=100.0):
    """A camera at x on the strip's axis that looks along it."""
    rotation = np.array([[0, 1.0, 0], [0, 0, 1], [1, 0, 0]])
    return Camera(64, 48, (focal, focal), (32.0, 24.0), rotation, -rotation @ [x, 0.5, 0.5])


def table(gaussians):
    """Rows float[N, numbers], in an order that depends on them only."""
    rows = np.concatenate([gaussians.rows[f.name].reshape(gaussians.count, -1) for f in LEARNED], axis=1)
    return rows[np.lexsort(rows.T)]


def blocks(model):
    """The strip in three blocks along x."""
    number = (model.positions[:, 0] * 3 / LENGTH).astype(int)
    return [
        Gaussians({name: rows[number == block] for name, rows in model.rows.items()}, model.sh_degree)
        for block in range(3)
    ]


@pytest.fixture(scope="module")
def model():
    return strip(COUNT, 0.05)


@pytest.fixture(scope="module")
def tree(model, tmp_path_factory):
    path = tmp_path_factory.mktemp("tree") / "model.tree"
    write_tree(path, iter(blocks(model)), model.sh_degree, (1e6, 2e6, 3.0), CELL)
    return Tree(path)


def content(tree, node):
    return Gaussians({name: tree.read(node, name) for name in ORDER}, tree.sh_degree)


def children(tree, node):
    return np.flatnonzero(tree.nodes["parent"] == node)


def leaves_below(tree, node):
    below = children(tree, node)
    return [node] if not len(below) else [leaf for child in below for leaf in leaves_below(tree, child)]


def test_the_leaves_are_the_model_and_the_others_a_quarter_of_what_they_replace(model, tree):
    leaves = np.flatnonzero(tree.is_leaf)
    assert tree.count == COUNT and tree.offset.tolist() == [1e6, 2e6, 3.0]
    assert sorted(leaves_below(tree, len(tree.nodes) - 1)) == leaves.tolist()
    assert (tree.nodes["count"][leaves] <= CELL).all() and len(leaves) < 3 * COUNT / CELL
    whole = Gaussians({name: np.concatenate([tree.read(leaf, name) for leaf in leaves]) for name in ORDER}, 1)
    assert np.array_equal(table(whole), table(model))
    for number in np.flatnonzero(~tree.is_leaf):
        node, below = tree.nodes[number], tree.nodes[children(tree, number)]
        assert 2 <= len(below) <= 4 and node["count"] == -(-int(below["count"].sum()) // 4)
        assert (node["low"] <= below["low"]).all() and (node["high"] >= below["high"]).all()
        assert node["sigma"] > below["sigma"].mean() and node["largest"] >= max(below["largest"])
        inside = content(tree, number)
        assert (inside.positions >= node["low"] - 1e-6).all()
        assert np.exp(inside.log_scales).max() <= node["largest"] * (1 + 1e-6)


@pytest.mark.parametrize("x, focal", [(-1.0, 500.0), (-1.0, 40.0), (30.0, 100.0), (-3000.0, 60.0)])
def test_nodes_replace_all_leaves_that_are_seen_once(tree, x, focal):
    """Near ones are finer; what is behind the camera is left out."""
    camera, pixels = at(x, focal), 2.0
    chosen = choose(tree, camera, pixels, 0.1)
    leaves = [leaf for node in chosen for leaf in leaves_below(tree, node)]
    assert len(set(leaves)) == len(leaves)
    every = np.flatnonzero(tree.is_leaf)
    for leaf in set(every) - set(leaves):  # none of it is in the picture
        assert (camera.project(tree.read(leaf, "positions"))[1] < 0.1 + 4).all()
    sigma = tree.nodes["sigma"][chosen]
    middle = (tree.nodes["usual_low"] + tree.nodes["usual_high"])[chosen, 0] / 2
    far = np.maximum(tree.nodes["usual_low"][chosen, 0] - x, 0)
    fine = ~tree.is_leaf[chosen]
    assert (focal * sigma[fine] <= pixels * np.hypot(far[fine], 1) + 1e-9).all()
    if x == -3000.0:
        assert chosen.tolist() == [len(tree.nodes) - 1]
    else:
        assert len(chosen) > 1 and np.corrcoef(middle, sigma)[0, 1] > 0 or focal == 500.0
    assert choose(tree, camera, 0.0, 0.1).tolist() == sorted(leaves_below(tree, len(tree.nodes) - 1)) or x == 30.0


def test_rows_at_one_place_are_parted():
    parts = parted(np.zeros((9, 3)), np.arange(9), 2, 2)
    assert sorted(map(len, parts)) == [2, 2, 2, 3] and sorted(np.concatenate(parts)) == list(range(9))


def test_damaged_trees_are_refused(tree, tmp_path):
    whole, path = tree.path.read_bytes(), tmp_path / "damaged.tree"
    place = HEADER.unpack(whole[: HEADER.size])[1]
    for damaged in (
        b"",
        b"ply\n",
        whole[:-1],
        whole[1:],
        whole + b"\0",
        whole[: place + 90] + b"\xff" + whole[place + 91 :],
    ):
        path.write_bytes(damaged)
        refused(lambda: Tree(path), "damaged.tree: not a tree of gaussians")
    refused(lambda: Tree(tmp_path / "missing.tree"), "missing.tree")
    with writing_tree(path, 0, np.zeros(3)):
        pass
    refused(lambda: Tree(path), "has no nodes")
    assert tree.nodes["parent"][-1] == NO_PARENT


def test_opaque_gaussians_count_in_the_mean_sigma():
    rows = dict(strip(2, 0.1).rows, opacity_logits=np.float32([0, -100]))
    rows["log_scales"] = np.log(np.float32([[1, 2, 3], [9, 9, 9]]))
    assert mean_sigma(Gaussians(rows, 1)) == pytest.approx(2)
    assert mean_sigma(Gaussians({**rows, "opacity_logits": np.float32([-1e9, -1e9])}, 1)) == 0


def test_parts_are_cut_across_their_longest_side_whichever_points_are_measured(monkeypatch):
    rng = np.random.default_rng(0)
    for most in (1 << 17, 50):
        monkeypatch.setattr("clsplat.edit.select.MOST_MEASURED", most)
        for axis in range(3):
            positions = rng.random((1000, 3))
            positions[:, axis] *= 3
            low, high = parted(positions, np.arange(1000), 600, 1)
            assert positions[low, axis].max() < positions[high, axis].min()
