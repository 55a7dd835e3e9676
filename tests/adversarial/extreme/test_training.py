"""Stiff trainings end well, or end plainly: finite numbers, and a line that says what is wrong.

A case changes the scene, the initial gaussians, the learning rates or the options of a short run.
"""

import itertools
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
import pytest

from clsplat.errors import InputError
from clsplat.gaussians import Gaussians
from clsplat.io.models.ply import read_ply, write_ply
from clsplat.io.photos.images import write_image
from clsplat.training import step
from clsplat.training.photos import Thumbnails
from clsplat.training.start.initialise import initial_gaussians
from clsplat.training.start.prepare import find_warnings
from tests.data.tiny_training import LEVELLED, options_of, records, trained

SAMPLE = 4  # of the city's points one in so many is taken: growth finds room


@dataclass(frozen=True)
class Case:
    """expects: "survives" (the run ends with finite numbers), "learns" (and its loss falls to
    `falls_to` of the first) or a part of the InputError; warns: parts of the warnings, one each;
    scene: (Scene, folder for photos) -> Scene; gaussians: (rows by field, rng) -> None, changes the
    initial ones in place; rates: all learning rates times this."""

    expects: str = "learns"
    warns: tuple[str, ...] = ()
    scene: Callable = lambda scene, folder: scene
    gaussians: Callable | None = None
    rates: float = 1.0
    options: dict = field(default_factory=dict)
    falls_to: float = 0.8


def rescaled(scene, factor):
    """The same scene in other units: points, cameras and offset times `factor`."""
    return replace(
        scene,
        points=scene.points * factor,
        offset=scene.offset * factor,
        views=tuple(
            replace(v, camera=replace(v.camera, translation=v.camera.translation * factor)) for v in scene.views
        ),
    )


def moved(scene, place):
    """The same scene around `place` float64[3], world, recentred as the readers do."""
    shift = np.asarray(place, np.float64)
    return replace(
        scene,
        points=scene.points + shift,
        offset=np.zeros(3),
        views=tuple(replace(v, camera=v.camera.shifted(-shift)) for v in scene.views),
    ).recentred()


def thinned(scene, every):
    """One point in `every`; observations go, as they count points."""
    return replace(scene, points=scene.points[::every], colours=scene.colours[::every], observations=None)


def with_photos(draw):
    """Photos of `draw(height, width, rng)` uint8[h, w, 3] in place of the scene's."""

    def change(scene, folder):
        rng = np.random.default_rng(0)
        views = []
        for number, view in enumerate(scene.views):
            path = folder / f"{number}.png"
            write_image(path, draw(view.camera.height, view.camera.width, rng))
            views.append(replace(view, source=path))
        return replace(scene, views=tuple(views))

    return change


def plain(grey):
    return with_photos(lambda height, width, _: np.full((height, width, 3), grey, np.uint8))


def noise(height, width, rng):
    return rng.integers(0, 256, (height, width, 3), np.uint8)


def copies_of_a_view(scene, count):
    """One view under so many names."""
    return replace(scene, views=tuple(replace(scene.views[5], name=f"{number}.png") for number in range(count)))


def turning(scene, _):
    """All cameras at one place, each looking its own way."""
    position = scene.views[0].camera.position
    return replace(
        scene,
        views=tuple(
            replace(v, camera=replace(v.camera, translation=-v.camera.rotation @ position)) for v in scene.views
        ),
    )


def crowded(count, size):
    """`count` points within `size` world units before the cameras."""

    def change(scene, _):
        rng = np.random.default_rng(0)
        points = np.median(scene.points, axis=0) + size * rng.uniform(-0.5, 0.5, (count, 3))
        colours = rng.integers(0, 256, (count, 3), np.uint8)
        return replace(scene, points=points, colours=colours, observations=None)

    return change


def with_outliers(scene, _):
    """Ten points a million times as far away as the rest, as bad matches leave them."""
    points = scene.points.copy()
    points[:10] *= 1e6
    return replace(scene, points=points)


def logits(*values):
    def change(rows, _):
        rows["opacity_logits"][:] = np.resize(values, len(rows["opacity_logits"]))

    return change


def wide_scales(rows, rng):
    """Sizes, and the axes of one gaussian, spread over a factor of 1e6."""
    rows["log_scales"] += np.log(10) * rng.uniform(-3, 3, rows["log_scales"].shape)


def strange_quaternions(rows, _):
    for k, factor in enumerate((0, 1e15, 1e-15)):
        rows["quaternions"][k::4] *= factor


def written(scene, case, path):
    """`path` after the case's initial gaussians were written there, for --init."""
    gaussians = Gaussians.from_points(scene.points, scene.colours, 3)
    rows = {name: values.copy() for name, values in gaussians.rows.items()}
    case.gaussians(rows, np.random.default_rng(0))
    write_ply(path, Gaussians(rows, 3), scene.offset)
    return path


FEW = {"sphere_neighbours": 5}  # ten points have no fifteen others
CASES = {
    "plain": Case(),
    "rates_x1000": Case("survives", rates=1000.0),
    "transparent": Case("survives", gaussians=logits(-40)),
    "wide_scales": Case("survives", gaussians=wide_scales),
    "strange_quaternions": Case(gaussians=strange_quaternions),
    "extent_1e6": Case(scene=lambda scene, _: rescaled(scene, 1e6 / scene.extent)),
    "equal_views": Case(
        warns=("the photos were taken from one place",), scene=lambda scene, _: copies_of_a_view(scene, 12)
    ),
    "one_view": Case("has a single photo", scene=lambda scene, _: replace(scene, views=scene.views[:1])),
    "two_views": Case(
        warns=("only 2 training photos",),
        options={"test_every": 0},
        scene=lambda scene, _: replace(scene, views=scene.views[:2]),
    ),
    "turning": Case("survives", ("the photos were taken from one place",), scene=turning),
    "black": Case("survives", ("are of one colour",), scene=plain(0)),
    "noise": Case("survives", scene=with_photos(noise)),
    "ten_points": Case(
        "survives",
        ("only 10 initial gaussians",),
        options=FEW,
        scene=lambda scene, _: thinned(scene, len(scene.points) // 10),
    ),
    "crowded": Case("survives", ("the sparse points cover",), scene=crowded(20_000, 0.01)),
    "outliers": Case("survives", scene=with_outliers),
}
SCHEDULES = {"constant": {"reset_every": 0}, "sig": {**LEVELLED, "reproject": "auto"}}
STEPS = 200
# nothing is left of these models, and what ends a training is said
EMPTIED = {"transparent", "rates_x1000"}


def prepared(city, case, schedule, folder):
    """(Scene, options as keywords) of a case."""
    scene = case.scene(thinned(city, SAMPLE), folder)
    options = {**SCHEDULES[schedule], "iterations": STEPS}
    options |= {
        name: value for name, value in case.options.items() if schedule == "sig" or not name.startswith("sphere")
    }
    if case.gaussians:
        options["init"] = str(written(scene, case, folder / "initial.ply"))
    return scene, options


@pytest.mark.nightly
@pytest.mark.parametrize("name, schedule", list(zip(CASES, itertools.cycle(SCHEDULES))))
def test_stiff(city, item_device, tmp_path, monkeypatch, name, schedule):
    case = CASES[name]
    scene, options = prepared(city, case, schedule, tmp_path)
    rates = step.learning_rates
    monkeypatch.setattr(
        step, "learning_rates", lambda *given: {field: case.rates * rate for field, rate in rates(*given).items()}
    )
    refusal = "all gaussians were pruned" if name in EMPTIED else case.expects
    if refusal not in ("learns", "survives"):
        with pytest.raises(InputError, match=refusal):
            trained(tmp_path / "run", scene, item_device, **options)
        return
    run = trained(tmp_path / "run", scene, item_device, **options)
    losses = [record["loss"] for record in records(run, "step")]
    assert losses and None not in losses  # null: not finite
    arrays, _ = run.load_checkpoint()
    for name, values in arrays.items():
        assert np.isfinite(values).all(), name
    read_ply(run.path / "point_cloud.ply")  # refuses what is not finite
    said = [record["text"] for record in records(run, "warning")]
    assert len(said) == len(case.warns) and all(map(str.__contains__, said, case.warns)), said
    if case.expects == "learns":
        assert losses[-1] < case.falls_to * losses[0], losses


@pytest.mark.parametrize("name", [name for name in CASES if CASES[name].warns])
def test_what_cannot_be_good_is_said(city, tmp_path, name):
    case = CASES[name]
    scene, options = prepared(city, case, "constant", tmp_path)
    options = options_of(**options)
    scene = scene.reduced(options.downscale)
    said = list(
        find_warnings(scene, Thumbnails(scene.split(options.test_every)[0]), initial_gaussians(scene, options).count)
    )
    assert len(said) == len(case.warns), said
    for text, part in zip(said, case.warns):
        assert part in text and "\n" not in text and len(text) < 160


@pytest.mark.parametrize("factor", [1e-9, 1000.0])
def test_a_normalised_scene_is_the_same_in_any_unit(city, factor):
    one, other = city.normalised(), rescaled(city, factor).normalised()
    assert one.extent == pytest.approx(1)
    assert other.unit == pytest.approx(factor * one.unit) and one.unit == city.extent
    assert np.array_equal(one.points.astype(np.float32), other.points.astype(np.float32))
    assert np.allclose(one.offset + one.unit * one.points, city.offset + city.points)
    for a, b in zip(one.views, other.views):
        assert np.array_equal(a.camera.translation.astype(np.float32), b.camera.translation.astype(np.float32))
    pixels, depths = city.views[3].camera.project(city.points)
    same, shallower = one.views[3].camera.project(one.points)
    assert np.allclose(same, pixels) and np.allclose(shallower * one.unit, depths)


def test_gaussians_in_other_units(city, tmp_path):
    """Those of a file begin where the scene's own do, whatever unit the scene is in."""
    options = options_of(schedule="sig", sphere=True, levels=(1.0,), sh_degree=0)
    given = initial_gaussians(city, options)
    write_ply(tmp_path / "a.ply", given, city.offset, sphere=True)
    scene = city.normalised()
    begun = initial_gaussians(scene, replace(options, init=str(tmp_path / "a.ply")))
    own = initial_gaussians(scene, options)
    assert set(begun.rows) == set(own.rows) and "anchors" in own.rows
    for name, values in own.rows.items():
        assert np.allclose(begun.rows[name], values, rtol=1e-5, atol=1e-6), name
        assert np.allclose(own.scaled(scene.unit).rows[name], given.rows[name], rtol=1e-5, atol=1e-5), name
