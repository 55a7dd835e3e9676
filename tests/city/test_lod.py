"""Levels of detail: every cell at the level that its distance asks for, and no gaussian lost."""

import numpy as np
import pytest
from click.testing import CliRunner

from clsplat.camera import Camera
from clsplat.cities import lod
from clsplat.cities.lod import Levels, merge_levels
from clsplat.cli.main import main
from clsplat.gaussians import LEARNED, Gaussians
from clsplat.io.models.ply import read_ply
from clsplat.io.runs.city import CityFolder
from clsplat.io.runs.run import RunFolder
from clsplat.io.scenes.read import fingerprint, read_scene
from clsplat.partition.partition import Partition
from clsplat.partition.region import Region, Space
from tests.data.tiny_training import CITY
from tests.reference.frequency import scene_frequency

SIGMAS = (0.4, 0.1, 0.02)  # world units, of the levels below
LENGTH = 100.0  # of the strip that they lie along


def strip(count, sigma, seed=0, degree=1):
    """Gaussians, all of one sigma, along x from 0 to LENGTH and about 1 thick."""
    rng = np.random.default_rng([seed, count])
    rows = {f.name: rng.normal(size=(count, *f.row_shape(degree))).astype(np.float32)
            for f in LEARNED}
    rows["positions"] = rng.uniform((0, 0, 0), (LENGTH, 1, 1), (count, 3)).astype(np.float32)
    rows["log_scales"] = np.full((count, 3), np.log(sigma), np.float32)
    return Gaussians(rows, degree)


@pytest.fixture(scope="module")
def models():
    return [strip(count, sigma) for count, sigma in zip((40, 200, 1000), SIGMAS)]


@pytest.fixture(scope="module")
def levels(models):
    return Levels.of(models, limit=64)


@pytest.fixture(scope="module")
def scene():
    return read_scene(CITY)


def at(x, focal=100.0):
    """A camera at x on the strip's axis that looks along it."""
    rotation = np.array([[0, 1.0, 0], [0, 0, 1], [1, 0, 0]])
    return Camera(64, 48, (focal, focal), (32.0, 24.0), rotation, -rotation @ [x, 0.5, 0.5])


def table(gaussians):
    """Rows float[N, numbers], in an order that depends on them only."""
    rows = np.concatenate([gaussians.rows[f.name].reshape(gaussians.count, -1)
                           for f in LEARNED], axis=1)
    return rows[np.lexsort(rows.T)]


# --- cells

def test_each_level_has_each_of_its_gaussians_in_one_cell(models, levels):
    cells = len(levels.firsts)
    assert 1000 / 64 <= cells <= 4 * 1000 / 64
    assert (np.diff(levels.firsts, axis=1)[:, -1] <= 64).all()
    for number, model in enumerate(models):
        whole = levels.select(np.full(cells, number))
        assert whole.sh_degree == 1 and np.array_equal(table(whole), table(model))


def test_a_cell_has_what_lies_between_its_planes_at_every_level(levels):
    """Along a strip the cells are intervals, and those of the levels are the same."""
    ends = np.array([[(x.min(), x.max()) if len(x) else (np.nan, np.nan) for x in (
        levels.rows["positions"][first:end, 0] for first, end in zip(f, f[1:]))]
        for f in levels.firsts])
    low, high = np.nanmin(ends[..., 0], axis=1), np.nanmax(ends[..., 1], axis=1)
    order = np.argsort(low)
    assert (high[order][:-1] <= low[order][1:]).all()
    assert ((levels.high - levels.low)[:, 0] <= high - low).all()


def test_gaussians_at_one_place_share_a_cell():
    model = strip(100, 0.1)
    model.rows["positions"][:] = 5
    assert len(Levels.of([model, model], limit=10).firsts) == 1


def test_outliers_do_not_stretch_a_box():
    model = strip(1000, 0.1)
    model.rows["positions"][7] = 1e4
    assert (Levels.of([model], limit=2000).high < 1.01 * LENGTH).all()


def test_blocks_do_not_share_cells_and_one_may_lack_a_level(models):
    def owner(positions):
        return (positions[:, 0] > 30).astype(int)

    coarse = models[0].rows["positions"][:, 0] <= 30
    lacking = Gaussians({name: rows[coarse] for name, rows in models[0].rows.items()}, 1)
    levels = Levels.of([lacking, *models[1:]], owner, limit=64)
    assert ((levels.low[:, 0] > 30) | (levels.high[:, 0] <= 30)).all()
    far = levels.choose(at(-1e5), pixels=1.0)
    there = np.diff(levels.firsts, axis=1)[:, 0] > 0
    assert np.array_equal(far, np.where(there, 0, 1)) and 0 < there.sum() < len(there)
    assert len(levels.select(far).positions) == coarse.sum() + sum(
        np.diff(levels.firsts, axis=1)[~there, 1])


def test_levels_of_different_degrees_get_the_highest(models):
    levels = Levels.of([strip(40, 0.4, degree=0), models[-1]], limit=64)
    coarse = levels.select(np.zeros(len(levels.firsts), int))
    assert coarse.sh_degree == 1 and coarse.sh_rest.shape == (40, 3, 3)
    assert not coarse.sh_rest.any()


# --- choice

def test_the_frequency_is_the_robust_one():
    rng = np.random.default_rng(0)
    scales, logits = rng.normal(-3, 2, (50, 3)), rng.normal(0, 3, 50)
    expected = scene_frequency(scales, logits)["robust_mean"]
    assert lod.frequency(scales, logits) == pytest.approx(expected, rel=1e-12)
    assert lod.frequency(scales[:0], logits[:0]) == 0


@pytest.mark.parametrize("level", range(len(SIGMAS) - 1))
def test_a_level_is_enough_up_to_its_pixels(levels, level):
    """At the very distance where its sigma is so many pixels wide, and not before."""
    pixels, focal, first = 1.5, 100.0, np.argmin(levels.low[:, 0])
    distance = focal * SIGMAS[level] / pixels
    for share, expected in ((1.001, level), (0.999, level + 1)):
        camera = at(levels.low[first, 0] - share * distance, focal)
        assert levels.choose(camera, pixels)[first] == expected


def test_near_cells_are_fine_and_far_ones_coarse(levels):
    choice = levels.choose(at(-1.0), pixels=1.7)[np.argsort(levels.low[:, 0])]
    assert set(choice) == {0, 1, 2} and (np.diff(choice) <= 0).all()
    drawn = levels.select(levels.choose(at(-1.0), pixels=1.7))
    # sigma tells the level of what is drawn: none coarser than its place asks for
    distance = drawn.positions[:, 0] + 1.0
    sigma = np.exp(drawn.log_scales[:, 0])
    assert (sigma[sigma > 0.03] <= 1.7 / 100 * distance[sigma > 0.03] * 1.001).all()
    inside = levels.choose(at(50.0), pixels=1.7)
    assert (inside[(levels.low[:, 0] <= 50) & (levels.high[:, 0] >= 50)] == 2).all()
    assert (levels.choose(at(-1e6), pixels=1.7) == 0).all()


# --- a city

def test_levels_of_a_city_are_those_of_its_blocks_cropped(scene, tmp_path):
    city = CityFolder(tmp_path)
    space = Space(np.eye(3), scene.offset, np.full(3, 30.0))
    low, high = np.full(3, -np.inf), np.full(3, np.inf)
    middle = np.array([0, np.inf, np.inf])
    regions = (Region(space, low, middle, 0.1), Region(space, -middle, high, 0.1))
    city.write({"fingerprint": fingerprint(scene)})
    city.write_partition(Partition("citygs", regions, (np.arange(4),) * 2).record())
    models = [strip(300, 0.2, seed) for seed in (1, 2)]
    for model in models:
        model.rows["positions"][:, 0] -= LENGTH / 2
    for number, model in enumerate(models):
        block = city.write_block(number, scene, np.arange(4), regions[number], {}, model, None, {},
                                 city.identity())
        for factor in (4.0, 2.0)[number:]:  # the second has no level 4
            RunFolder.create(block.run).save_snapshot(factor, model, scene.offset)
    assert merge_levels(city, scene) == [4.0, 2.0]
    left = models[0].positions[:, 0] < 0
    right = models[1].positions[:, 0] >= 0
    four, two = (read_ply(path, scene.offset) for _, path in RunFolder(city.path).snapshots())
    assert four.count == left.sum() and two.count == left.sum() + right.sum()
    assert np.allclose(two.positions, np.concatenate([models[0].positions[left],
                                                      models[1].positions[right]]), atol=1e-4)


# --- the command

def test_a_bias_of_levels_wants_levels(tmp_path):
    result = CliRunner().invoke(main, ["render", str(tmp_path), "-o", str(tmp_path / "out"),
                                       "--lod-bias", "2"])
    assert result.exit_code == 2 and result.output.count("\n") == 1, result.output
    assert "--lod-bias: has no effect without --lod" in result.output
