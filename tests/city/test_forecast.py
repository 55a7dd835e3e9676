"""How many gaussians a city is expected to have, and what larger ones take."""

from pathlib import Path
from types import SimpleNamespace

import pytest

from clsplat.cities import run
from clsplat.cities.city import City
from clsplat.errors import InputError
from clsplat.io.runs.city import CityFolder
from clsplat.options import resolve
from clsplat.partition.options import LEAST_GAUSSIANS, PartitionOptions
from tests.city.test_city import a_card
from tests.command_line import clsplat_
from tests.data.tiny_training import CITY


def test_the_expected_number_is_the_limit_of_the_schedule(city):
    points = len(city.points)
    pixels = sum(view.camera.width * view.camera.height for view in city.views)

    def expected(**options):
        chosen = resolve({}, {"test_every": 0, **options})
        return run.expected_gaussians(facts(chosen), chosen)

    def facts(chosen):
        return run.facts_of_whole(city, chosen)[0]

    assert expected(schedule="mcmc", max_gaussians=points + 7) == points + 7
    assert expected(schedule="mcmc", max_gaussians=7) == points, "it begins with so many"
    assert expected(schedule="constant") == pixels // run.PIXELS_PER_GAUSSIAN
    assert expected(pixels_per_gaussian=90.0) == pixels // 90
    assert expected(pixels_per_gaussian=90.0, downscale=2.0) == pytest.approx(max(points, pixels / 360), rel=0.01)
    shown_in = facts(resolve({}, {"test_every": 0})).shown_in
    assert 3 < shown_in < 9
    assert expected(pixels_per_gaussian=20.0) == int(pixels / shown_in / run.PIXELS_OF_A_PLACE) < pixels // 20


def test_blocks_that_share_a_device_fit_it_together(city, tmp_path):
    options, device = resolve({}, {}), a_card(2**36)
    whole = City(CityFolder(tmp_path), city, options, device)

    def largest(*given):
        return run.chosen_partition({}, whole, *given).block_gaussians

    assert largest() == largest(2, 2) == largest(1, 4) == run.gaussians_that_fit(device, options)
    assert largest(8, 2) == largest() // 4
    assert run.chosen_partition({}, whole, 8, 2).sharing == 4
    budget = resolve({}, {"memory_budget": "2GiB"})
    assert run.gaussians_that_fit(device, budget) == run.gaussians_that_fit(a_card(2**31), options)
    device.handle.global_mem_size = 1
    assert largest(8) == LEAST_GAUSSIANS


@pytest.mark.one_in(3)
@pytest.mark.parametrize(
    "flags, numbers",
    [
        ((), (None, 1)),
        (("--workers", "4"), (4, 1)),
        (("--device", "cpu,cpu"), (None, 2)),
        (("--workers", "4", "--device", "cpu,cpu"), (4, 2)),
        (("--scheduler", "tcp://127.0.0.1:1"), (1, 1)),
        (("--workers", "4", "--scheduler", "tcp://127.0.0.1:1"), (4, 4)),
    ],
)
def test_workers_share_the_devices_that_are_named(tmp_path, monkeypatch, flags, numbers):
    """On a cluster each has its own."""

    def noted(*given):
        assert given[2:4] == numbers
        raise InputError("noted")

    monkeypatch.setattr(run, "chosen_partition", noted)
    result = clsplat_("city", CITY, "-o", tmp_path / "city", "-q", *flags)
    assert result.exit_code == 2 and not (tmp_path / "city").exists()


def test_a_scene_that_fits_in_one_block_needs_no_city():
    def note(**chosen):
        return run.one_block_note(PartitionOptions(**{"expected": 10**6, **chosen}), Path("my scene"))

    assert "`clsplat train my scene`" in note(block_gaussians=4 * 10**6)
    assert note(block_gaussians=2 * 10**6) == "", "margins belong to several blocks"
    assert note(block_gaussians=4 * 10**6, least_blocks=2) == "", "two workers"
    assert note(block_gaussians=4 * 10**6, grid=(2, 2)) == ""


def hours(table):
    """The hours of all devices, and those until the end, in the first row of a `scale_table`."""
    return [float(cell) for cell in table.rows[0][7:9]]


def test_what_ten_times_the_photos_take():
    device = a_card(2**30)
    view = SimpleNamespace(camera=SimpleNamespace(width=100, height=50))
    options = resolve({}, {"iterations": 1000})
    limit = run.gaussians_that_fit(device, options)
    planned = SimpleNamespace(
        train_views=[view] * 80, scene=SimpleNamespace(views=[view] * 100), decisions=SimpleNamespace(facts=None)
    )
    forecast = SimpleNamespace(gaussians=limit // 2, seconds=3600.0, steps=1000)

    def scale_table(*given):
        return run.scale_table(planned, options, forecast, device, *given)

    small, large = scale_table([200, 2000]).rows
    assert small[:4] == ("200", "1", "200", "2,000") and small[7] == "2"
    # twenty times the scene, each part of it in 1.6**2 blocks, which share twice the steps
    assert large[1] in ("25", "26") and large[7] == f"{20 * 2.25:.3g}"
    table = scale_table([200], 4)
    assert large[1:2] == scale_table([2000], 4).rows[0][1:2]
    rounds = -(-int(large[1]) // 4)  # of blocks on four devices, after the coarse run
    assert hours(scale_table([2000], 4))[1] == pytest.approx(20 * (0.25 + 2 * rounds / int(large[1])), rel=0.006)
    assert table.rows[0][1] == "4" and hours(table) == pytest.approx([4.5, 0.5 + 1], abs=0.006)
    # one run takes the steps of its schedule: 300 a photo of 80 in 100, and at least 7,000
    options = resolve({}, {"schedule": "constant"})
    forecast = SimpleNamespace(gaussians=1, seconds=3600.0, steps=24_000)
    assert hours(run.scale_table(planned, options, forecast, device, [110]))[0] == pytest.approx(1.1, rel=0.006)
    assert run.scale_table(planned, options, forecast, device, [10]).rows[0][3] == "7,000"
