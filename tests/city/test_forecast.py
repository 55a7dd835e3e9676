"""How many gaussians a city is expected to have, and what larger ones take on other devices."""

from types import SimpleNamespace

import numpy as np
import pytest

from clsplat.camera import Camera
from clsplat.city.forecast import (
    PIXELS_PER_GAUSSIAN,
    expected_gaussians,
    gaussians_that_fit,
    scale_table,
)
from clsplat.errors import InputError
from clsplat.estimate.measured import MeasuredSteps
from clsplat.estimate.step_time import fitted, predicted_seconds
from clsplat.io.scenes import read_scene
from clsplat.options import resolve
from clsplat.scene import View
from clsplat.schedule.simulate import Segment
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


def test_larger_photos_on_another_device():
    device = SimpleNamespace(name="a card", real=np.dtype(np.float32),
                             handle=SimpleNamespace(global_mem_size=2**30))
    view = SimpleNamespace(camera=SimpleNamespace(width=100, height=50))
    options = resolve({}, {"iterations": 1000})
    planned = SimpleNamespace(prepared=SimpleNamespace(train_views=[view] * 100,
                                                       options=options))
    limit = gaussians_that_fit(device, options)
    # photos of four times the pixels, on a card with eight times the memory: four times the
    # gaussians, and four times the time but for a quarter of it
    known = MeasuredSteps("another", 2**33, [(5000, 100, 0.9), (5000, 200, 0.9), (20000, 100, 2.7)])
    assert fitted(known.steps) == pytest.approx([0.3, 0.6 / 5000, 0])
    forecast = SimpleNamespace(gaussians=limit // 2, seconds=1200.0, steps=1000,
                               measured=known.steps)
    table = scale_table(planned, forecast, device, 0.5, [200], (200, 100), 1, known)
    assert table.rows[0][1] == "1" and int(table.rows[0][4].replace(",", "")) // 4 == limit
    assert table.rows[0][7:9] == (f"{2 * (300 + 4 * 900) / 3600:.2f}",) * 2
    assert "another" in table.notes[0] and "200x100" in table.notes[0]
    # three devices: four times the work in three blocks, after the coarse run
    table = scale_table(planned, forecast, device, 0.5, [200], (200, 100), 3, known)
    one = 2 * (300 + 4 * 900) / 3600
    assert table.rows[0][1] == "3"
    assert table.rows[0][7:9] == (f"{4.25 * one:.2f}", f"{(0.25 + 4 / 3) * one:.2f}")


def test_steps_of_another_device_come_from_a_file(tmp_path):
    file, views = tmp_path / "steps.json", [View("a", Camera(
        100, 50, (80.0, 80.0), (50.0, 25.0), np.eye(3), np.zeros(3)), b"")]
    steps = [(5000.0, 100.0, 0.9), (5000.0, 200.0, 0.9), (20000.0, 100.0, 2.7)]
    MeasuredSteps("a card", 2**33, steps).write(file)
    known = MeasuredSteps.read(file)
    assert known == MeasuredSteps("a card", 2**33, steps)
    segments = [Segment(10, 1.0, 100, False)]
    seconds, ends, measured = predicted_seconds(
        None, SimpleNamespace(train_views=views), None, segments, known=known.steps)
    assert seconds == pytest.approx(9.0) and ends[0][2] == pytest.approx(0.9)
    assert measured == steps
    for damaged in ("{", '{"device": 1}', file.read_text().replace("0.9", "-1"),
                    file.read_text().replace("0.9", '"x"')):
        file.write_text(damaged)
        with pytest.raises(InputError, match="not a file of measured steps"):
            MeasuredSteps.read(file)
    with pytest.raises(InputError, match="no such file; `clsplat plan --steps-to`"):
        MeasuredSteps.read(tmp_path / "none.json")
