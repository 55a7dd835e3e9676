"""How many gaussians a city is expected to have, and when its blocks end."""

from pathlib import Path
from types import SimpleNamespace

import pytest

from clsplat.city.forecast import (
    PIXELS_PER_GAUSSIAN,
    block_table,
    exchange_notes,
    expected_gaussians,
)
from clsplat.io.scenes import read_scene
from clsplat.options import resolve
from tests.data.tiny_training import CITY


def test_the_expected_number_is_the_limit_of_the_schedule():
    scene = read_scene(CITY)
    points = len(scene.points)
    pixels = sum(view.camera.width * view.camera.height for view in scene.views)

    def expected(**options):
        return expected_gaussians(scene, resolve({}, {"test_every": 0, **options}))

    assert expected(schedule="mcmc", mcmc_cap=points + 7) == points + 7
    assert expected(schedule="mcmc", mcmc_cap=7) == points, "it begins with so many"
    assert expected(schedule="constant") == pixels // PIXELS_PER_GAUSSIAN
    assert expected(pixels_per_gaussian=20.0) == pixels // 20
    assert expected(pixels_per_gaussian=20.0, downscale=2.0) == pytest.approx(pixels / 80, rel=0.01)


def test_the_end_of_the_blocks_on_several_devices_follows_from_their_steps():
    def block(number, steps):
        record = {"own": 10, "margin": 4, "surroundings": 0, "views": 8,
                  "options": {"iterations": steps}}
        return SimpleNamespace(path=Path(f"{number:03d}"), read=lambda *_: record)

    city = SimpleNamespace(blocks=lambda: [block(n, 100 * n) for n in (1, 2, 3, 4)])
    table = block_table(city, None, [10] * 4)
    assert table.rows[3] == ("004", "10", "4", "0", "0", "8", "400") and len(table.rows) == 4
    assert "50% on 2, 40% on 3, 40% on 8 (--workers)" in table.notes[0]


def test_exchanges_leave_files():
    blocks = [{"own": 2**20, "exchanges": [100, 200]}, {"own": 2**19, "exchanges": [100, 200]}]
    (note,) = exchange_notes(blocks, 3.0)
    assert "2 times" in note and "6,372 MiB" in note  # 708 * 3 * 2 * 1.5
    assert exchange_notes([{"own": 9}], 3.0) == ()
