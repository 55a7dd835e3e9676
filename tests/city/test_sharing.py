"""How many blocks share a GPU where nobody says so, and who trains them."""

import os
from types import SimpleNamespace

import numpy as np
import pytest

import clsplat.city.dense as dense
import clsplat.cli.city as city_module
from clsplat.city.sharing import PROCESS_BYTES, blocks_sharing
from clsplat.cli.city import partition_options
from clsplat.cli.main import main
from clsplat.errors import InputError
from clsplat.io.runs.city import CityFolder
from clsplat.io.scenes.read import read_scene
from clsplat.options import resolve
from tests.data.tiny_training import CITY


def a_card(memory, is_cpu=False):
    return SimpleNamespace(name="a card", is_cpu=is_cpu, real=np.dtype(np.float32),
                           handle=SimpleNamespace(global_mem_size=memory))


def test_blocks_share_a_gpu_with_cores_and_memory_for_each(monkeypatch):
    monkeypatch.setattr(os, "cpu_count", lambda: 16)
    block = 2**29
    assert blocks_sharing(a_card(2**36), 9, block) == 4
    assert blocks_sharing(a_card(2**36), 3, block) == 3
    two = 4 * (block + PROCESS_BYTES)  # half of it is for two blocks
    assert blocks_sharing(a_card(two), 9, block) == 2
    assert blocks_sharing(a_card(two - 1), 9, block) == 1
    assert blocks_sharing(a_card(1), 9, block) == blocks_sharing(a_card(2**36), 0, block) == 1
    assert blocks_sharing(a_card(2**36, is_cpu=True), 9, block) == 1
    monkeypatch.setattr(os, "cpu_count", lambda: 11)
    assert blocks_sharing(a_card(2**36), 9, block) == 2
    monkeypatch.setattr(os, "cpu_count", lambda: None)
    assert blocks_sharing(a_card(2**36), 9, block) == 1


def test_large_blocks_have_the_gpu_to_themselves(tmp_path, monkeypatch):
    monkeypatch.setattr(os, "cpu_count", lambda: 64)
    scene = read_scene(CITY)

    def chosen(given, memory=2**36, *numbers, **changes):
        return partition_options(given, scene, resolve({}, changes), a_card(memory),
                                 CityFolder(tmp_path), *numbers or (None,))

    assert chosen({"grid": (2, 2)}).workers == 4
    # so many gaussians, 2.56 times as many with margins, and 2.6 kB for each
    assert chosen({"grid": (2, 2)}, schedule="mcmc", max_gaussians=8_000_000).workers == 2
    assert chosen({"grid": (3, 1)}).workers == 3
    assert chosen({}).workers == 1 and not chosen({}).several
    assert chosen({"grid": (2, 2)}, 2**36, 1).workers == 1
    assert chosen({"grid": (3, 3)}, 2**36, None, 2).workers == 8
    assert chosen({"grid": (3, 1)}, 2**36, None, 2).workers == 4
    assert chosen({}, 2**36, None, 2).least_blocks == 2, "one for each device"
    small = chosen({}, 2**22)  # a device that is full with one block
    assert small.several and small.workers == 1
    assert small.block_gaussians == chosen({}, 2**22, 1).block_gaussians


@pytest.mark.parametrize("early, late, ended, children", [
    (2, 2, [], 2), (2, 1, [2], None), (3, 2, [3], 2), (1, 2, [], 2), (1, 1, [], None)])
def test_children_start_early_and_are_as_many_as_fit(tmp_path, monkeypatch, early, late, ended,
                                                     children):
    """Whether blocks can share the device is known once that is open and the scene was read."""
    class Children(list):
        def __init__(self, number, devices, needed):
            super().__init__(range(number))

        def __exit__(self, *error):
            pass

        def __enter__(self):
            return self

        def end(self):
            told.append(len(self))

    def found_beside(_city, _scene, _options, children):
        helpers.append(children and len(children))
        raise InputError("enough")

    helpers, told = [], []
    monkeypatch.setattr(city_module, "most_sharing", lambda blocks: early)
    monkeypatch.setattr(city_module, "blocks_sharing", lambda device, blocks, memory: late)
    monkeypatch.setattr("clsplat.distribute.Children", Children)
    monkeypatch.setattr(dense, "found_beside", found_beside)
    with pytest.raises(SystemExit):
        main(["city", str(CITY), "-o", str(tmp_path / "city"), "-q", "--grid", "2x1",
              "--joint-steps", "0.5", "-n", "12", "-r", "8"])
    assert helpers == [children] and told == ended
