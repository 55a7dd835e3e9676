"""What is predicted of a training: its course, its memory, its time."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from clsplat.camera import Camera
from clsplat.device import Device
from clsplat.estimate import forecast as module
from clsplat.estimate.forecast import Memory, fitted, forecast, photo_bytes, pixels, tried_sizes
from clsplat.estimate.trial_steps import TrialSteps, sampled
from clsplat.gaussians import Gaussians
from clsplat.io.photos.images import write_image
from clsplat.io.scenes.read import read_scene
from clsplat.options import resolve
from clsplat.rendering.pipeline import Renderer
from clsplat.scene import View
from clsplat.schedule.plan import SceneFacts
from clsplat.schedule.registry import OURS, schedule_of
from clsplat.schedule.simulate import Segment, largest, simulate
from clsplat.schedule.steps import scaled_steps
from clsplat.training.photos import Photos, size_note
from clsplat.training.progress import SilentProgress
from clsplat.training.session import Session
from clsplat.training.start.prepare import prepare
from tests.command_line import clsplat_
from tests.data.tiny_training import CITY, options_of, records, trained


@pytest.fixture(scope="module")
def city():
    return read_scene(CITY).reduced(4)


def course_of(count, pixels, size=(512, 382), **options):
    options = scaled_steps(resolve({}, options))
    facts = SceneFacts(size, count, 20.0, tuple, pixels)
    return simulate(schedule_of(options.schedule)(options, facts))


@pytest.mark.parametrize(
    "count, views, size, steps, ended",
    [
        (15689, 24, (512, 382), 7000, 117_220),
        (25683, 65, (509, 383), 30000, 316_781),
        (4400, 28, (320, 240), 7000, 53_677),
    ],
    ids=["boruszyn", "caliterra", "city"],
)
def test_runs_that_meet_their_ceiling_end_as_foretold(count, views, size, steps, ended):
    segments = course_of(count, views * size[0] * size[1], size, iterations=steps, pixels_per_gaussian=40.0)
    assert largest(segments) == pytest.approx(ended, rel=0.01)
    assert sum(segment.steps for segment in segments) == steps
    levels = list(dict.fromkeys(segment.level for segment in segments))
    assert levels == sorted(levels, reverse=True) and levels[-1] == 1


def test_a_budget_is_reached_and_a_limit_is_kept():
    assert largest(course_of(4400, 10**7, schedule="taming", iterations=7000)) == pytest.approx(15 * 4400, rel=0.01)
    for schedule in OURS:
        segments = course_of(4400, 10**7, schedule=schedule, iterations=7000, max_gaussians=9000)
        assert 8900 < largest(segments) <= 9000


def test_demand_is_that_of_fine_detail():
    """Of few gaussians a share asks; later a share of the pixels, less where photos are blurred and
    positions have settled."""

    def counts(detail=None, **limits):
        options = scaled_steps(resolve({}, {"schedule": "constant", "iterations": 30000, **limits}))
        facts = SceneFacts((512, 382), 1000, 20.0, tuple, 10**6)
        return [s.gaussians for s in simulate(schedule_of("constant")(options, facts), detail)]

    sharp = counts()
    assert sharp[1] == 1400
    added = np.diff(sharp)
    assert added.max() < 9000 and 9000 * 0.03**0.5 < added[-1] < 9000 * 0.03**0.48
    assert counts(lambda level: 1.0) == sharp
    blurred = np.diff(counts(lambda level: 0.00625))
    assert blurred[-1] == pytest.approx(added[-1] / 8, rel=0.01)
    limited = counts(max_gaussians=30_000)
    assert limited[:9] == sharp[:9]  # room is not demand


def test_photos_that_overlap_much_and_dense_points_ask_for_less():
    def added(**facts):
        options = scaled_steps(resolve({}, {"schedule": "constant", "iterations": 30000}))
        facts = SceneFacts((512, 382), 10**5, 20.0, tuple, 10**6, **facts)
        counts = [s.gaussians for s in simulate(schedule_of("constant")(options, facts))]
        return counts[1] - counts[0]

    usual = added()
    assert added(shown_in=3.0) == added(shown_in=5.0) == usual
    assert added(shown_in=20.0) == pytest.approx(usual / 4, rel=0.01)
    assert added(dense=True) == pytest.approx(0.4 * usual, rel=0.01)


def test_detail_is_what_half_the_size_would_not_show(tmp_path):
    board = np.kron(np.indices((8, 8)).sum(axis=0) % 2, np.ones((1, 1)))[..., None].repeat(3, 2)
    lines = np.zeros((8, 8, 3))
    lines[:, ::2] = 255
    cases = (
        ("board", 255 * board, 0.5),
        ("columns", lines, 0.5),
        ("rows", lines.transpose(1, 0, 2), 0.5),
        ("flat", 0 * board + 90, 0.0),
        ("blocks", np.kron(255 * board, np.ones((2, 2, 1))), 0.0),
    )
    for name, image, expected in cases:
        write_image(tmp_path / f"{name}.png", image.astype(np.uint8))
        height, width = image.shape[:2]
        camera = Camera(width, height, (10.0, 10.0), (4.0, 4.0), np.eye(3), np.zeros(3))
        view = View(name, camera, tmp_path / f"{name}.png")
        assert module.photo_detail([view], 1.0) == pytest.approx(expected, abs=1e-6), name


def test_photos_are_compared_while_growing_only():
    segments = course_of(4400, 10**6, iterations=3000, reproject="on")
    assert {s.regularises for s in segments} == {True, False} and not segments[-1].regularises
    assert not any(s.regularises for s in course_of(4400, 10**6, iterations=3000))


PARTS = [
    {"poses": "on"},
    {"exposure": "on", "vignetting": "on", "reproject": "on", "robust": "on"},
    {"batch": 3},
    {"sh_degree": 1, "engine": "numpy"},
]


@pytest.mark.slow  # the group form takes half a minute on a CPU
@pytest.mark.parametrize("options", PARTS, ids=str)
@pytest.mark.one_in(8)
def test_trial_steps_foretell_what_a_training_allocates(float_device, options):
    """At a size between those that were tried, with photos that stay and with photos that do not;
    frames of the second have more room, as views are met in another order."""
    device = Device(float_device.handle, form=float_device.form)  # nothing is allocated yet
    prepared = prepare(
        read_scene(CITY),
        resolve({}, {"exposure": "off", "downscale": 4.0, "test_every": 0, "sphere": False, **options}),
        device,
    )
    gaussians = sampled(prepared.scene, 5000, prepared.options.sh_degree)
    regularises = options.get("reproject") == "on"
    segments = [Segment(1, 2.0, 3000, regularises), Segment(1, 1.0, 5000, regularises)]
    trials = module.take_trials(device, prepared, 3000, segments, SilentProgress())
    assert len(trials) == 3 and trials[:, 2].all()
    memory = module.predicted_memory(device, prepared, gaussians.rows, gaussians.count, segments, trials)
    device.trim()
    assert device.memory_bytes < 10_000  # trials give back what they take
    photos = Photos(device, prepared.train_views)
    trial = TrialSteps(Session(prepared, device, gaussians, photos=photos))
    for index in range(len(prepared.train_views)):
        trial.prepare(index, regularises)()
    trial.finish()
    assert memory.steps == pytest.approx(device.memory_bytes, rel=0.15)
    assert memory.photos == sum(photos[index].nbytes for index in range(len(photos.views)))
    assert memory.resident and memory.model < memory.steps <= memory.total


def test_photos_that_do_not_fit_are_counted_one_at_a_time(item_device, city, monkeypatch):
    each = 3 * 80 * 60
    assert photo_bytes(item_device, city.views, 1.0) == (each * len(city.views), True)
    monkeypatch.setattr("clsplat.training.photos.DEVICE_SHARE", 0.0)
    assert photo_bytes(item_device, city.views, 1.0) == (each, False)


def measured_peak(device, monkeypatch):
    """A list whose last element is the most that was allocated on a device so far."""
    allocate, peaks = device._new, [0]

    def noting(*arguments):
        array = allocate(*arguments)
        peaks.append(max(peaks[-1], device.memory_bytes))
        return array

    monkeypatch.setattr(device, "_new", noting)
    return peaks


@pytest.mark.slow
@pytest.mark.parametrize(
    "options",
    [
        pytest.param(
            {"schedule": "sig", "levels": (2.0, 1.0), "downscale": 2.0, "iterations": 600}, marks=pytest.mark.nightly
        ),
        {"schedule": "taming", "downscale": 4.0, "iterations": 240, "taming_budget": 4.0},
    ],
    ids=str,
)
def test_a_run_takes_what_was_foretold(tmp_path, item_device, monkeypatch, options):
    """Memory, which has the margins of training/capacity.py, within 20 %, at its peak 30 %; of the
    time no more is asked for than a busy machine can keep. What the forms allocate is counted
    above."""
    scene = read_scene(CITY)
    options = {
        "exposure": "off",
        "reset_every": 0,
        "prune_opacity": 0.005,
        "densify_from": 100,
        "densify_every": 25,
        "grow_threshold": 2e-5,
        "densify_until": 0,
        **options,
    }
    estimating = Device(item_device.handle, form="item")
    foretold = forecast(prepare(scene, options_of(**options), estimating), estimating)
    fresh = Device(item_device.handle, form="item")
    peaks = measured_peak(fresh, monkeypatch)
    run = trained(tmp_path, scene, fresh, **options)
    steps = records(run, "step")
    assert max(step["gaussians"] for step in (*steps, *records(run, "grow"))) == pytest.approx(
        foretold.gaussians, rel=0.2
    )
    assert foretold.memory.steps == pytest.approx(max(step["memory_bytes"] for step in steps), rel=0.2)
    assert foretold.memory.total == pytest.approx(peaks[-1], rel=0.3)
    assert 0.2 < foretold.seconds / steps[-1]["train_seconds"] < 5


def test_three_costs_are_found_again():
    cost = (2e-3, 3e-8, 4e-7)
    made = [(image, count, np.dot(cost, (1, image, count))) for image in (1e4, 2e5) for count in (1000, 5000)]
    made = np.array(made).T
    assert fitted(*made) == pytest.approx(cost)
    a, b, c = fitted(*made[:, made[0] == 1e4])
    assert (a + b * 1e4, c) == pytest.approx((2e-3 + 3e-8 * 1e4, 4e-7))
    assert (fitted(*np.array([(1e4, 10, 2.0), (1e4, 20, 1.0)]).T) >= 0).all()


def test_a_course_costs_what_its_steps_do(city):
    segments = [Segment(10, 2.0, 100, False), Segment(5, 1.0, 200, False)]
    small, large = pixels(city.views, 2.0), pixels(city.views, 1.0)
    assert (small, large) == (40 * 30, 80 * 60)
    measured = [(image, count, 1 + 0.1 * image + 0.01 * count) for image in (small, large) for count in (100, 200)]
    assert module.predicted_seconds(np.array(measured), city.views, segments) == pytest.approx(
        10 * (1 + 0.1 * small + 1) + 5 * (1 + 0.1 * large + 2)
    )


@pytest.mark.parametrize("count", [50, 4400, 6000])
def test_strewn_gaussians_are_about_the_points(city, count):
    gaussians = sampled(city, count, 1)
    assert gaussians.count == count and gaussians.sh_degree == 1
    away, _ = cKDTree(city.points).query(gaussians.positions)
    size = np.exp(Gaussians.from_points(city.points, city.colours).log_scales[:, 0])
    assert np.median(away) < 0.1 * np.median(size) and (away < 3 * size.max()).all()
    assert (away > 1e-3).sum() == pytest.approx(max(0, count - len(city.points)), rel=0.01)


def sized_views(width, height):
    camera = Camera(width, height, (width, width), (width / 2, height / 2), np.eye(3), np.zeros(3))
    return (View("a.jpg", camera, "a.jpg"),)


@pytest.mark.parametrize("levels", [(1.0,), (5.0, 1.0)], ids=str)
def test_large_photos_are_timed_at_two_smaller_sizes(levels):
    segments = [Segment(10, level, 50_000, False) for level in levels]
    for views in (sized_views(5472, 4088), sized_views(54720, 40880)):
        sizes = tried_sizes(views, 1000, segments, 200_000)
        images = {round(pixels(views, level)) for level, _ in sizes}
        assert max(images) < 1.001 * module.MOST_PIXELS and len(images) == 2
        assert min(images) < 0.26 * max(images)  # far enough apart to extrapolate from
    small = tried_sizes(sized_views(1600, 1195), 1000, segments, 200_000)
    assert {level for level, _ in small} == set(levels)


def test_pairs_are_counted_as_rendering_finds_them(float_device, city):
    renderer, camera = Renderer(float_device, 0, city.near_plane), city.views[3].camera
    gaussians = sampled(city, 3000, 0)
    rows = {name: float_device.upload(values) for name, values in gaussians.rows.items()}
    packed = renderer.pack(camera)
    frame = renderer.render(rows, packed, camera.width, camera.height, 0)
    splats, tiles = renderer.measure(rows, packed, camera.width, camera.height)
    assert splats == len(frame.visible) > 100 and tiles.sum() == frame.pairs.count > 100
    assert len(renderer.visible(rows, packed)) == splats


def test_photos_that_are_reduced_are_named():
    options = resolve({}, {})
    assert options.max_resolution == 1600
    large, small = sized_views(5472, 4088), sized_views(1600, 1200)
    assert size_note((*small, *large), options) == (
        "photos of 5472x4088 are reduced to 1600x1195; --max-resolution none keeps their size"
    )
    assert size_note(small, options) is None
    assert size_note(large, resolve({}, {"max_resolution": 0})) is None
    assert size_note(large, resolve({}, {"downscale": 4.0})) is None  # -r does it already


@pytest.mark.slow
def test_the_command_says_it_all(monkeypatch, item_device):
    monkeypatch.setattr("clsplat.device.choose_device", lambda *_, **__: item_device)
    result = clsplat_("plan", CITY, "-r", 8, "-n", 60, "--schedule", "constant")
    assert result.exit_code == 0, result.output
    lines = [line.split() for line in result.stdout.splitlines()]
    assert result.stderr.startswith("reading the scene\nplanning: inspecting the photos\n")
    assert result.stdout.startswith("city: 28 photos to train on, 4 held out, 4,400 points; ")
    assert " ".join(line[0] for line in lines[1:]) == (
        "steps init levels gaussians sh exposure vignetting reproject robust engine photos memory time"
    )
    assert "exposure      off: requested\n" in result.output
    assert "sh degree     3: requested\n" in result.output
    assert "for 60 steps: a step takes " in result.output


@pytest.mark.parametrize(
    "words, complaint",
    [
        ((CITY / "nothing",), "no such scene"),
        ((CITY, "--test-every", 1), "holds out every view"),
        ((CITY, "--sh-degree", "x"), "--sh-degree x: expects a whole number"),
        ((CITY, "--levels", "90,1"), "less than a tile"),
    ],
)
def test_what_cannot_begin_is_one_line(monkeypatch, words, complaint):
    monkeypatch.setattr("clsplat.device.choose_device", lambda *_, **__: None)
    result = clsplat_("plan", *words)
    assert result.exit_code == 2 and complaint in result.stderr
    said = [
        line
        for line in result.stderr.splitlines()
        if line not in ("reading the scene", "planning: inspecting the photos")
    ]
    assert len(said) == 1 and said[0].startswith("error: ")


def test_a_time_budget_decides_the_steps(item_device, city, monkeypatch):
    for name, value in (
        ("take_trials", []),
        ("predicted_memory", Memory(0, 0, 0, True, 0)),
        ("predicted_seconds", 3000.0),
    ):
        monkeypatch.setattr(module, name, lambda *_, value=value: value)
    options = resolve({}, {"time_budget": "2m", "schedule": "taming", "exposure": "off"})
    found = forecast(prepare(city, options, item_device), item_device)
    assert (found.steps, found.seconds) == (8400 * 120 // 3000, 120)  # 28 photos
