"""Frames of trees: those of the model in one piece, with bounded memory."""

import subprocess
import sys

import numpy as np
import pytest

from clsplat.cities.tree import facts_of
from clsplat.edit.select import selected
from clsplat.gaussians import Gaussians
from clsplat.io.models.tree import ORDER, Tree, writing_tree
from clsplat.rendering.pipeline import Renderer
from clsplat.rendering.tree import MOST_SIGMA_PIXELS, TreeRenderer
from tests.city.test_tree import strip
from tests.data.made_tree import write_tree
from tests.kernels.chain import camera_of, size_of, stored_degree
from tests.rendering.test_slabs import downloaded, faint, same_to_rounding


def test_the_finest_nodes_are_drawn_as_the_model(float_device, tmp_path, monkeypatch):
    """In one piece to the same bytes, given the rows in the same order; in slabs to rounding."""
    monkeypatch.setitem(MOST_SIGMA_PIXELS, False, 0.0)
    case = faint("plain")
    degree = stored_degree(case)
    write_tree(tmp_path / "tree", iter([Gaussians(case["rows"], degree)]), degree, np.zeros(3), 16)
    tree = Tree(tmp_path / "tree")
    settings = float_device, degree, case["near"], False, case["background"]
    leaves = np.flatnonzero(tree.is_leaf)
    renderer = Renderer(*settings)
    rows = {name: float_device.upload(np.concatenate([tree.read(leaf, name) for leaf in leaves])) for name in ORDER}
    camera, size = camera_of(case), size_of(case)
    whole = downloaded(renderer.render(rows, renderer.pack(camera), *size, degree, True))
    for limit in (None, 17):
        streamed = TreeRenderer(float_device, tree, case["near"], False, case["background"], limit=limit)
        frames = [streamed.render(tree, streamed.pack(camera), *size, degree, True) for _ in range(2)]
        assert np.array_equal(*(frame.image.download() for frame in frames))
        if limit is None:
            assert all(map(np.array_equal, downloaded(frames[1]), whole))
        else:
            assert frames[1].slabs > 1
            same_to_rounding(downloaded(frames[1]), whole)


PROGRAM = """
import sys
from pathlib import Path
from clsplat.camera import Camera
from clsplat.device import choose_device
from clsplat.io.models.tree import Tree
from clsplat.rendering.tree import MOST_SIGMA_PIXELS, TreeRenderer, choose

def resident(name):
    status = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines())
    return float(status[name].split()[0]) / 1024

camera = Camera.looking_at((50, 0.5, 0.5), (50, -60, 40), width=96, height=64)
device = choose_device("Portable")
MOST_SIGMA_PIXELS[False] = 0.0  # the leaves
for path in sys.argv[1:]:  # the first compiles the kernels
    before = resident("VmRSS")
    Path("/proc/self/clear_refs").write_text("5")  # the peak so far is forgotten
    tree = Tree(path)
    renderer = TreeRenderer(device, tree, 0.1, host_bytes=16 << 20)
    renderer.render(tree, camera, 96, 64, 1)
    chosen = choose(tree, camera, 0.0, 0.1)
    assert tree.nodes["count"][chosen].sum() > 0.9 * tree.count
print(resident("VmHWM") - before)
"""


@pytest.mark.slow
def test_a_model_larger_than_the_memory_for_it_is_drawn(tmp_path):
    """27 MiB of gaussians with 16."""
    paths = [tmp_path / "small", tmp_path / "large"]
    for path, count in zip(paths, (2000, 300_000)):
        model = strip(count, 0.02)
        with writing_tree(path, 1, np.zeros(3)) as writer:
            leaves = [
                writer.add(part, facts_of(part))
                for part in (
                    selected(model, np.arange(begin, min(begin + 2048, count))) for begin in range(0, count, 2048)
                )
            ]
            writer.add(selected(model, np.arange(10)), facts_of(model), leaves)
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM, *map(str, paths)], capture_output=True, text=True, timeout=600, check=False
    )
    assert done.returncode == 0, done.stderr
    assert paths[1].stat().st_size > 26 << 20
    assert float(done.stdout) < 16 + 8
