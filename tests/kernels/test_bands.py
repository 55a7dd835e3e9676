"""Frames in bands of tiles: the same bytes as in one piece, back to the gaussians."""

import numpy as np
import pyopencl as cl
import pyopencl.tools
import pytest

from clsplat.errors import DeviceError, OutOfDeviceMemory
from clsplat.rendering.bin import PAIR_LIMIT, count_tiles, tile_grid
from clsplat.rendering.blend import Exposure, choose_bands
from clsplat.rendering.contribution import contribution
from tests import cases
from tests.kernels.chain import gradients_by_row, render, size_of
from tests.kernels.test_pipeline import assert_same, cotangents

SPREAD = "giants"  # 61 x 37 pixels: each gaussian has pairs in most tiles, so in most bands


def rendered_and_back(device, case, with_depth=True, **options):
    """(frame, gradients) from random cotangents."""
    renderer, rows, frame = render(device, case, with_depth=with_depth, **options)
    grads = map(device.upload, cotangents(case)[: 3 if with_depth else 1])
    return frame, renderer.adjoint(rows, frame, *grads)


def results(device, case, with_depth=True, **options):
    """(frame, all that comes of it): image, depth, transmittance, contributions, gradients."""
    exposure = Exposure(device.upload(np.linspace(-1, 2, 24).reshape(2, 12)), 1)
    frame, gradients = rendered_and_back(device, case, with_depth, exposure=exposure, **options)
    weights = device.upload(np.random.default_rng(2).random(size_of(case)[::-1]))
    sums = contribution(device, frame, weights)
    drawn = frame.image, frame.exposed, frame.blended.transmittance, sums, gradients.means
    if with_depth:
        drawn += (frame.blended.depth,)
    return frame, [array.download() for array in drawn] + list(gradients_by_row(gradients, case).values())


def cuts(tiles_x, tiles_y):
    """Ways to cut a frame: name -> the first tiles of the bands."""
    tiles = tiles_x * tiles_y
    return {
        "one": [0],
        "two": [0, tiles // 2 + 1],
        "a row each": range(0, tiles, tiles_x),
        "a tile each": range(tiles),
        "within rows": range(0, tiles, tiles_x + 1),
    }


@pytest.mark.slow
@pytest.mark.parametrize("name, with_depth", [(SPREAD, True), (SPREAD, False), ("ragged", True)])
@pytest.mark.one_in(6)
def test_however_a_frame_is_cut_its_bytes_are_the_same(device, monkeypatch, name, with_depth):
    case = cases.gaussians(name)
    _, expected = results(device, case, with_depth)
    tiles_x, tiles_y = tile_grid(device, *size_of(case))
    for cut, firsts in cuts(tiles_x, tiles_y).items():
        bands = [range(*ends) for ends in zip(firsts, [*firsts[1:], tiles_x * tiles_y])]
        monkeypatch.setattr("clsplat.rendering.blend.choose_bands", lambda *_: bands)  # noqa: B023
        frame, actual = results(device, case, with_depth, pair_limit=0)
        assert frame.pairs is None and frame.bands == bands, cut
        assert_same(expected, actual)


@pytest.mark.slow
@pytest.mark.parametrize("share", [0.6, 0.3, 0.15])
@pytest.mark.one_in(4)
def test_a_frame_above_the_limit_is_rendered_in_bands_below_it(device, share):
    case = cases.gaussians("many", count=300)
    whole, expected = results(device, case)
    counts = count_tiles(device, whole.splats, whole.counts, *whole.size)
    limit = int(share * whole.pairs.count)
    frame, actual = results(device, case, pair_limit=limit)
    sizes = [counts[band.start : band.stop].sum() for band in frame.bands]
    assert max(sizes) <= limit and sum(sizes) == whole.pairs.count
    assert 1 / share < len(frame.bands) < 2 / share + 1
    assert_same(expected, actual)


@pytest.mark.one_in(2)
def test_pairs_that_do_not_fit_a_buffer_come_in_bands(device, monkeypatch):
    """Without a limit, it follows from the device's largest buffer."""
    case = cases.gaussians(SPREAD, count=400)
    whole, expected = results(device, case)
    largest = {"item": 64, "group": 200}[device.form] * 256 * device.real.itemsize
    monkeypatch.setattr(device, "largest_buffer", largest)
    with pytest.raises(OutOfDeviceMemory, match="one buffer"):
        results(device, case, pair_limit=PAIR_LIMIT)
    frame, actual = results(device, case)
    assert len(frame.bands) > 2
    assert_same(expected, actual)


def test_memory_that_is_refused_is_an_error_of_its_own(float_device, monkeypatch):
    def refuse(size):
        raise cl.MemoryError("clCreateBuffer failed: MEM_OBJECT_ALLOCATION_FAILURE")

    monkeypatch.setattr(float_device, "_new_block", refuse)
    with pytest.raises(OutOfDeviceMemory, match="no memory for 3 MiB more.*--max-gaussians"):
        float_device.zeros((3 << 18,))


@pytest.mark.parametrize("seed", range(20))
def test_bands_are_as_few_as_the_limit_allows(seed):
    rng = np.random.default_rng(seed)
    counts = rng.integers(0, 50, 200) * rng.integers(0, 2, 200)
    for limit in (50, 120, 2000, int(counts.sum())):
        bands = choose_bands(counts, limit)
        assert [tile for band in bands for tile in band] == list(range(200))
        sizes = [counts[band.start : band.stop].sum() for band in bands]
        assert max(sizes) <= limit
        assert all(size + counts[band.stop] > limit for size, band in zip(sizes, bands[:-1]))


def test_a_tile_above_the_limit_is_refused(device):
    with pytest.raises(DeviceError, match=r"31 pairs .* single tile, more than 30.*--max-gaus"):
        choose_bands(np.array([3, 31, 2]), 30)
    with pytest.raises(DeviceError, match="single tile, more than 0"):
        render(device, cases.gaussians(SPREAD), pair_limit=0)
