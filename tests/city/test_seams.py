"""The seam report: silent where blocks agree, loud where one was spoilt, and there only."""

import functools
from dataclasses import replace

import numpy as np
import pytest

from clsplat.cities.merge import cropped, joined
from clsplat.cities.seams import LEAST_PIXELS, _scores, find_borders, find_seams
from clsplat.evaluation.views import opened, render_view
from clsplat.gaussians import Gaussians
from clsplat.io.photos.images import write_image
from clsplat.io.scenes.read import read_scene
from clsplat.options import TrainOptions
from clsplat.partition.region import Partition, Region, Space
from clsplat.rendering.slabs import open_model
from clsplat.report.city import seam_table
from tests.data.tiny_training import CITY

OPTIONS = TrainOptions()
SEAM = 0.3  # dB, what issue 5 allows


def boxes(cells, space=None, margin=0.1):
    """Partition of cells ((low x, low y), (high x, high y)), without end in height."""
    space = space or Space(np.eye(3), np.zeros(3), np.full(3, 10.0))
    regions = [Region(space, np.array([*low, -np.inf]), np.array([*high, np.inf]), margin) for low, high in cells]
    return Partition("citygs", tuple(regions), (np.arange(2),) * len(regions))


INF = np.inf
QUARTERS = [([-INF, -INF], [0, 0]), ([0, -INF], [INF, 0]), ([-INF, 0], [0, INF]), ([0, 0], [INF, INF])]
# one cell beside two
BISECTED = [([-INF, -INF], [-0.2, INF]), ([-0.2, -INF], [INF, 0.4]), ([-0.2, 0.4], [INF, INF])]


@pytest.mark.parametrize(
    "cells, pairs",
    [
        (QUARTERS, {(0, 1), (2, 3), (0, 2), (1, 3)}),
        (BISECTED, {(0, 1), (0, 2), (1, 2)}),
        ([([-INF, -INF], [INF, INF])], set()),
    ],
)
def test_neighbours_share_a_face_and_each_pair_comes_once(cells, pairs):
    """Cells that only touch at an edge are no neighbours."""
    found = find_borders(boxes(cells))
    assert {border.blocks for border in found} == pairs and len(found) == len(pairs)


def test_a_strip_is_owned_and_reached_by_its_two_blocks():
    partition = boxes(BISECTED)
    points = np.random.default_rng(0).uniform(-15, 15, (20000, 3))
    coordinates, owner = partition.space.to(points), partition.owner(points)
    reached = [region.reaches(points) for region in partition.regions]
    for border in find_borders(partition):
        inside = border.pixels(coordinates)
        assert set(owner[inside].tolist()) == set(border.blocks)
        assert all(reached[block][inside].all() for block in border.blocks)
    between = find_borders(partition)[0]  # sides of 0.8 and 1.2
    assert between.high[0] - between.low[0] == pytest.approx(2 * 0.1 * 0.8)


@pytest.fixture(scope="module")
def scene():
    scene = read_scene(CITY)
    return replace(scene, views=scene.views[::4]).reduced(4)


@pytest.fixture(scope="module")
def model(scene):
    gaussians = Gaussians.from_points(scene.points, scene.colours, 0)
    gaussians.rows["opacity_logits"][:] = 2
    return gaussians


@pytest.fixture(scope="module")
def photos(scene, tmp_path_factory):
    """device -> the scene with photos that it took of the model: the model is the truth, but
    for the exposure."""

    @functools.cache
    def photographed(device, model):
        folder, opened = tmp_path_factory.mktemp("photos"), (*open_model(device, model, scene.near_plane), 0)
        views = []
        for view in scene.views:
            path = folder / f"{view.name}.png"
            write_image(path, 0.8 * render_view(*opened, view.camera))
            views.append(replace(view, source=path))
        return replace(scene, views=tuple(views))

    return photographed


@pytest.fixture
def photographed(item_device, photos, model):
    return photos(item_device, model)


def noisy(model, seed, size):
    """The model with other colours: what an imperfect training would leave."""
    rows = {name: values.copy() for name, values in model.rows.items()}
    rows["sh_constant"] += np.random.default_rng(seed).normal(0, size, rows["sh_constant"].shape)
    return Gaussians(rows, model.sh_degree)


@functools.cache
def report(device, scene, model, spoil=lambda number, gaussians: gaussians):
    """Seams of four blocks that err alike, as the reference does, and a little by themselves;
    spoil: changes a block."""
    reference = noisy(model, 9, 0.2)
    space = Space(np.eye(3), scene.offset, np.full(3, 30.0))
    partition = boxes(QUARTERS, space, margin=0.15)
    blocks = [spoil(number, noisy(reference, number, 0.02)) for number in range(4)]
    pieces = [cropped(block, partition, number, scene.offset) for number, block in enumerate(blocks)]
    return find_seams(
        partition, scene, scene.views, *(opened(device, each, scene, OPTIONS) for each in (joined(pieces), reference))
    )


def test_blocks_that_agree_have_no_seam(item_device, photographed, model):
    seams = report(item_device, photographed, model)
    assert len(seams["borders"]) == 4
    assert abs(seams["seam_db"]) < SEAM / 2 and seams["worst_seam_db"] < SEAM
    for record in seams["borders"]:
        assert record["pixels"] > 1000
        assert record["psnr"] > 30  # without the fit of colours it is below 20
    table = seam_table(seams).text()
    assert "000 | 001" in table and "all" in table


def test_blocks_that_are_worse_everywhere_have_no_seam(item_device, photographed, model):
    """They lose to the reference, but not beside their borders."""
    seams = report(item_device, photographed, model, lambda number, gaussians: noisy(gaussians, 5, 0.2))
    lost = min(record["reference_psnr"] - record["psnr"] for record in seams["borders"])
    assert lost > 1.5 and abs(seams["seam_db"]) < lost / 4


def test_a_block_that_is_worse_beside_its_borders_is_a_seam(item_device, photographed, model):
    """As blocks are whose margins no view has trained."""

    def spoil(number, gaussians):
        if number == 3:
            near = abs(gaussians.positions[:, :2]).min(axis=1) < 4
            gaussians.rows["sh_constant"][near] -= np.float32([0.8, 0, 0])
        return gaussians

    seams = report(item_device, photographed, model, spoil)
    values = {tuple(record["blocks"]): record["seam_db"] for record in seams["borders"]}
    assert seams["worst_seam_db"] > SEAM and seams["seam_db"] > SEAM
    assert min(values[1, 3], values[2, 3]) > SEAM
    assert max(values[0, 1], values[0, 2]) < min(values[1, 3], values[2, 3])


def test_a_border_is_the_mean_of_its_views_by_their_pixels():
    """errors: pixels, of the model, of the reference; in the strip and elsewhere."""

    def view(near, far, near_error, far_error):
        return [[near, near * near_error, near * 1e-3], [far, far * far_error, far * 1e-3]]

    errors = [
        view(3000, 9000, 1e-2, 1e-3),
        view(1000, 5000, 1e-3, 1e-4),
        view(LEAST_PIXELS - 1, 9000, 1.0, 1e-3),
        view(9000, LEAST_PIXELS - 1, 1.0, 1e-3),
    ]
    scores = _scores(errors)
    assert scores["pixels"] == 13_000 + LEAST_PIXELS - 1
    assert scores["psnr"] == pytest.approx((3 * 20 + 30) / 4)
    assert scores["elsewhere_psnr"] == pytest.approx((3 * 30 + 40) / 4)
    assert scores["reference_psnr"] == scores["elsewhere_reference_psnr"] == pytest.approx(30)
    assert scores["seam_db"] == pytest.approx(2.5 + 7.5)
    assert _scores(errors[2:])["seam_db"] is None and _scores([])["pixels"] == 0


def test_what_cannot_be_said_is_left_open(item_device, scene, model):
    partition = boxes(QUARTERS, Space(np.eye(3), scene.offset, np.full(3, 30.0)))
    on_device = opened(item_device, model, scene, OPTIONS)
    empty = find_seams(partition, scene, [], on_device, on_device)
    assert empty["worst_seam_db"] is None and empty["seam_db"] is None
    assert "-" in seam_table(empty).text()
