"""How many gaussians a city is expected to have, when its blocks end, and what larger ones take."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import clsplat.cities.forecast as forecast_module
import clsplat.cities.run as city_module
from clsplat.camera import Camera
from clsplat.cities.forecast import (
    PIXELS_PER_GAUSSIAN,
    block_table,
    coarse_steps,
    exchange_notes,
    expected_gaussians,
    facts_of_whole,
    gaussians_that_fit,
    one_block_note,
    scale_table,
)
from clsplat.cities.run import chosen_partition
from clsplat.cli.main import main
from clsplat.errors import InputError
from clsplat.estimate.cost import fitted, predicted_seconds
from clsplat.estimate.measured import MeasuredSteps
from clsplat.io.runs.city import CityFolder
from clsplat.io.scenes.read import read_scene
from clsplat.options import resolve
from clsplat.partition.options import LEAST_GAUSSIANS, PartitionOptions
from clsplat.scene import View
from clsplat.schedule.simulate import Segment
from tests.city.test_city import a_card
from tests.data.tiny_training import CITY


def test_the_expected_number_is_the_limit_of_the_schedule():
    scene = read_scene(CITY)
    points = len(scene.points)
    pixels = sum(view.camera.width * view.camera.height for view in scene.views)

    def expected(**options):
        chosen = resolve({}, {"test_every": 0, **options})
        return expected_gaussians(facts_of_whole(scene, chosen)[0], chosen)

    assert expected(schedule="mcmc", max_gaussians=points + 7) == points + 7
    assert expected(schedule="mcmc", max_gaussians=7) == points, "it begins with so many"
    assert expected(schedule="constant") == pixels // PIXELS_PER_GAUSSIAN
    assert expected(pixels_per_gaussian=20.0) == pixels // 20
    assert expected(pixels_per_gaussian=20.0, downscale=2.0) == pytest.approx(pixels / 80, rel=0.01)


def test_blocks_that_share_a_device_fit_it_together(tmp_path):
    scene, options = read_scene(CITY), resolve({}, {})
    device = SimpleNamespace(real=np.dtype(np.float32), handle=SimpleNamespace(
        global_mem_size=2**36))

    def largest(*given):
        return chosen_partition({}, scene, options, device, CityFolder(tmp_path),
                                 *given).block_gaussians

    assert largest() == largest(2, 2) == largest(1, 4) == gaussians_that_fit(device, options)
    assert largest(8, 2) == largest() // 4
    device.handle.global_mem_size = 1
    assert largest(8) == LEAST_GAUSSIANS


@pytest.mark.one_in(2)
@pytest.mark.parametrize("flags, numbers", [
    ((), (None, 1)), (("--workers", "4"), (4, 1)), (("--device", "cpu,cpu"), (None, 2)),
    (("--workers", "4", "--device", "cpu,cpu"), (4, 2)),
    (("--scheduler", "tcp://127.0.0.1:1"), (1, 1)),
    (("--workers", "4", "--scheduler", "tcp://127.0.0.1:1"), (4, 4))])
def test_workers_share_the_devices_that_are_named(tmp_path, monkeypatch, flags, numbers):
    """On a cluster each has its own."""
    def noted(*given):
        assert given[5:7] == numbers
        raise InputError("noted")

    monkeypatch.setattr(city_module, "chosen_partition", noted)
    with pytest.raises(SystemExit) as ended:
        main(["city", str(CITY), "-o", str(tmp_path / "city"), "-q", *flags])
    assert ended.value.code == 2 and not (tmp_path / "city").exists()


def test_the_end_of_the_blocks_on_several_devices_follows_from_their_steps():
    def block(number, steps):
        record = {"own": 10, "margin": 4, "surroundings": 0, "views": 8,
                  "options": {"iterations": steps}}
        return SimpleNamespace(path=Path(f"{number:03d}"), read=lambda *_: record)

    city = SimpleNamespace(blocks=lambda: [block(n, 100 * n) for n in (1, 2, 3, 4)])
    table = block_table(city, None, [10] * 4)
    assert table.rows[3] == ("004", "10", "4", "0", "0", "8", "400") and len(table.rows) == 4
    assert "50% on 2, 40% on 3, 40% on 8 (--workers)" in table.notes[0]


def test_steps_of_the_coarse_run_are_known_on_its_device(monkeypatch):
    def step(iteration, seconds, level, count):
        return {"event": "step", "iteration": iteration, "train_seconds": seconds, "level": level,
                "gaussians": count}

    records = [step(1, 1.0, 2.0, 90), {"event": "grow"}, step(101, 3.0, 2.0, 100),
               step(201, 6.0, 1.0, 110),  # a change of level: reading photos is not a step
               step(301, 7.0, 1.0, 120), step(401, 7.0, 1.0, 130), step(501, 8.5, 1.0, 140)]
    camera = Camera(100, 50, (80.0, 80.0), (50.0, 25.0), np.eye(3), np.zeros(3))
    run = SimpleNamespace(record={"opencl_device": "a card", "kernel_form": "group"},
                          scene=lambda: SimpleNamespace(views=[View("a", camera, b"")]),
                          folder=SimpleNamespace(past_records=lambda: records))
    monkeypatch.setattr(forecast_module, "Run", SimpleNamespace(open=lambda _: run))
    city = SimpleNamespace(coarse=Path("coarse"))

    def known(name="a card", form="group"):
        return coarse_steps(city, SimpleNamespace(name=name, form=form))

    assert known() == [(1250.0, 100.0, 0.02), (5000.0, 120.0, 0.01), (5000.0, 140.0, 0.015)]
    assert known("another") == known(form="item") == []
    del records[-1]
    assert known() == [], "two steps do not tell three numbers"


@pytest.mark.parametrize("seconds, tried", [(0.1, False), (1.0, True)])
def test_short_trainings_are_foretold_without_trial_steps(monkeypatch, seconds, tried):
    """Two blocks of 1000 steps: 200 seconds in all, and 2000."""
    record = {"own": 10, "margin": 4, "surroundings": 0, "views": 8,
              "options": {"iterations": 1000}}
    city = SimpleNamespace(blocks=lambda: [
        SimpleNamespace(path=Path(f"{n:03d}"), read=lambda *_: record) for n in (1, 2)])
    asked = []

    def planned(known=()):
        asked.append(list(known))
        return SimpleNamespace(seconds=1000 * seconds, steps=1000, gaussians=28,
                               memory=SimpleNamespace(total=2**20))

    block = SimpleNamespace(scene=None, parts=lambda _: ())
    for name, value in (("Planned", lambda *_, parts: SimpleNamespace(forecast=planned)),
                        ("BlockScene", SimpleNamespace(read=lambda _: block)),
                        ("block_options", lambda _: None),
                        ("coarse_steps", lambda *_: [(1.0, 1.0, seconds)])):
        monkeypatch.setattr(forecast_module, name, value)
    (note, *_) = block_table(city, a_card(2**33), [10, 10]).notes
    assert asked == [[(1.0, 1.0, seconds)], []][:1 + tried]
    assert ("from steps of block 001" in note) == tried
    assert ("from steps of the coarse run" in note) != tried
    assert f"All blocks take {2000 * seconds / 60:.1f} minutes" in note


def test_a_scene_that_fits_in_one_block_needs_no_city():
    def note(**chosen):
        return one_block_note(PartitionOptions(**{"expected": 10**6, **chosen}), Path("my scene"))

    assert "`clsplat train my scene`" in note(block_gaussians=4 * 10**6)
    assert note(block_gaussians=2 * 10**6) == "", "margins belong to several blocks"
    assert note(block_gaussians=4 * 10**6, least_blocks=2) == "", "two workers"
    assert note(block_gaussians=4 * 10**6, grid=(2, 2)) == ""


def test_exchanges_leave_files():
    blocks = [{"own": 2**20, "exchanges": [100, 200]}, {"own": 2**19, "exchanges": [100, 200]}]
    (note,) = exchange_notes(blocks, 3.0)
    assert "2 times" in note and "6,372 MiB" in note  # 708 * 3 * 2 * 1.5
    assert exchange_notes([{"own": 9}], 3.0) == ()


def planned_photos():
    """(A device of 1 GiB, a plan of 100 photos of 100x50 pixels, the gaussians that fit it)."""
    device = SimpleNamespace(name="a card", real=np.dtype(np.float32),
                             handle=SimpleNamespace(global_mem_size=2**30))
    view = SimpleNamespace(camera=SimpleNamespace(width=100, height=50))
    options = resolve({}, {"iterations": 1000})
    planned = SimpleNamespace(prepared=SimpleNamespace(train_views=[view] * 100,
                                                       options=options))
    return device, planned, gaussians_that_fit(device, options)


def hours(table):
    """The hours of all devices, and those until the end, in the first row of a `scale_table`."""
    return [float(cell) for cell in table.rows[0][7:9]]


def test_what_ten_times_the_photos_take():
    device, planned, limit = planned_photos()
    forecast = SimpleNamespace(gaussians=limit // 2, seconds=3600.0)
    head, *_ = table = scale_table(planned, forecast, device, 0.5, [200, 2000]).rows
    small, large = (dict(zip(("photos", "blocks", "views", "steps", "gaussians", "model", "pixels",
                              "hours"), row)) for row in table)
    assert head[0] == "200" and small["blocks"] == "1" and small["hours"] == "2.00"
    assert small["steps"] == "2,000" and small["views"] == "200"
    # twenty times the scene, each part of it in four blocks, which share twice the steps
    assert large["blocks"] in ("40", "39") and large["hours"] == f"{20 * 2.25:.2f}"
    assert large["steps"] in ("1,000", "1,026")


def test_larger_photos_on_another_device():
    device, planned, limit = planned_photos()
    # photos of four times the pixels, on a card with eight times the memory: four times the
    # gaussians, and four times the time but for a quarter of it
    known = MeasuredSteps("another", 2**33, [(5000, 100, 0.9), (5000, 200, 0.9), (20000, 100, 2.7)])
    assert fitted(known.steps) == pytest.approx([0.3, 0.6 / 5000, 0])
    forecast = SimpleNamespace(gaussians=limit // 2, seconds=1200.0, steps=1000,
                               measured=known.steps)
    table = scale_table(planned, forecast, device, 0.5, [200], (200, 100), 1, known)
    assert table.rows[0][1] == "1"
    assert int(table.rows[0][4].replace(",", "")) == pytest.approx(4 * limit, abs=4)
    # two digits of a fit, half a unit of the last one apart on some machines
    assert hours(table) == pytest.approx([2 * (300 + 4 * 900) / 3600] * 2, abs=0.006)
    assert "another" in table.notes[0] and "200x100" in table.notes[0]
    # three devices: twice the work in three blocks, after the coarse run
    table = scale_table(planned, forecast, device, 0.5, [200], (200, 100), 3, known)
    one = 2 * (300 + 4 * 900) / 3600
    assert table.rows[0][1] == "3"
    assert hours(table) == pytest.approx([2.25 * one, (0.25 + 2 / 3) * one], abs=0.006)


def test_steps_of_another_device_come_from_a_file(tmp_path):
    file, views = tmp_path / "steps.json", [View("a", Camera(
        100, 50, (80.0, 80.0), (50.0, 25.0), np.eye(3), np.zeros(3)), b"")]
    steps = [(5000.0, 100.0, 0.9), (5000.0, 200.0, 0.9), (20000.0, 100.0, 2.7)]
    MeasuredSteps("a card", 2**33, steps).write(file)
    known = MeasuredSteps.read(file)
    assert known == MeasuredSteps("a card", 2**33, steps)
    segments = [Segment(10, 1.0, 100, False)]
    assert predicted_seconds(known.steps, views, segments) == pytest.approx(9.0)
    for damaged in ("{", '{"device": 1}', file.read_text().replace("0.9", "-1"),
                    file.read_text().replace("0.9", '"x"')):
        file.write_text(damaged)
        with pytest.raises(InputError, match="not a file of measured steps"):
            MeasuredSteps.read(file)
    with pytest.raises(InputError, match="no such file; `clsplat plan --steps-to`"):
        MeasuredSteps.read(tmp_path / "none.json")
