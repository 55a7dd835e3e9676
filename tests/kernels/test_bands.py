"""Frames in bands of tiles: the same bytes as in one piece, back to the gaussians."""

from collections import Counter

import numpy as np
import pyopencl as cl
import pyopencl.tools
import pytest

from clsplat.constants import FRAME_COUNTS
from clsplat.device.array import Array
from clsplat.errors import DeviceError, OutOfDeviceMemory
from clsplat.rendering.bands import choose_bands, pair_limit, pair_reals
from clsplat.rendering.bin import PAIR_LIMIT, count_tiles, tile_grid
from clsplat.rendering.blend import Exposure
from clsplat.rendering.contribution import contribution
from tests import cases
from tests.kernels.chain import gradients_by_row, render, size_of
from tests.kernels.test_pipeline import assert_same, cotangents

SPREAD = "giants"  # 61 x 37 pixels: each gaussian has pairs in most tiles, so in most bands


def rendered_and_back(device, case, with_depth=True, **options):
    """(frame, gradients) from random cotangents."""
    renderer, rows, frame = render(device, case, with_depth=with_depth, **options)
    grads = map(device.upload, cotangents(case)[:3 if with_depth else 1])
    return frame, renderer.adjoint(rows, frame, *grads)


def results(device, case, with_depth=True, **options):
    """(frame, all that comes of it): image, depth, transmittance, contributions, gradients."""
    exposure = Exposure(device.upload(np.linspace(-1, 2, 24).reshape(2, 12)), 1)
    frame, gradients = rendered_and_back(device, case, with_depth, exposure=exposure, **options)
    weights = device.upload(np.random.default_rng(2).random(size_of(case)[::-1]))
    sums = contribution(device, frame, weights)
    drawn = frame.image, frame.exposed, frame.blended.transmittance, sums, gradients.means
    if with_depth:
        drawn += frame.blended.depth,
    return frame, [array.download() for array in drawn] + list(
        gradients_by_row(gradients, case).values())


def cuts(tiles_x, tiles_y):
    """Ways to cut a frame: name -> the first tiles of the bands."""
    tiles = tiles_x * tiles_y
    return {"one": [0], "two": [0, tiles // 2 + 1], "a row each": range(0, tiles, tiles_x),
            "a tile each": range(tiles), "within rows": range(0, tiles, tiles_x + 1)}


@pytest.mark.slow
@pytest.mark.parametrize("name, with_depth", [(SPREAD, True), (SPREAD, False), ("ragged", True)])
def test_however_a_frame_is_cut_its_bytes_are_the_same(device, monkeypatch, name, with_depth):
    case = cases.gaussians(name)
    _, expected = results(device, case, with_depth)
    tiles_x, tiles_y = tile_grid(device, *size_of(case))
    for cut, firsts in cuts(tiles_x, tiles_y).items():
        bands = [range(*ends) for ends in zip(firsts, [*firsts[1:], tiles_x * tiles_y])]
        monkeypatch.setattr("clsplat.rendering.pipeline.choose_bands", lambda *_: bands)  # noqa: B023
        frame, actual = results(device, case, with_depth, pair_limit=0)
        assert frame.pairs is None and frame.bands == bands, cut
        assert_same(expected, actual)


@pytest.mark.one_in(2)
def test_gaussians_have_gradients_from_every_band(device):
    """The test above would compare little if each gaussian lay in one band."""
    frame, _ = results(device, cases.gaussians(SPREAD))
    counts = frame.pairs.splat_counts.download()
    assert np.median(counts) > 0.7 * len(frame.pairs.tiles)


@pytest.mark.parametrize("share", [0.6, 0.3, 0.15])
@pytest.mark.one_in(5)
def test_a_frame_above_the_limit_is_rendered_in_bands_below_it(device, share):
    case = cases.gaussians("many", count=300)
    whole, expected = results(device, case)
    counts = count_tiles(device, whole.splats, whole.counts, *whole.size)
    limit = int(share * whole.pairs.count)
    frame, actual = results(device, case, pair_limit=limit)
    sizes = [counts[band.start:band.stop].sum() for band in frame.bands]
    assert max(sizes) <= limit and sum(sizes) == whole.pairs.count
    assert 1 / share < len(frame.bands) < 2 / share + 1
    assert_same(expected, actual)


def test_bands_without_splats_show_the_background(device):
    case = cases.gaussians("many", count=40)
    case["rows"]["positions"][:, 1] = abs(case["rows"]["positions"][:, 1])
    case["camera"] = cases.camera(*size_of(case))  # upright: all splats are in the lower half
    case["rows"]["log_scales"][:] = np.log(0.02)
    case["rows"]["opacity_logits"][:] = 0
    whole, expected = results(device, case)
    tiles_x, _ = tile_grid(device, *whole.size)
    counts = count_tiles(device, whole.splats, whole.counts, *whole.size)
    assert not counts[:2 * tiles_x].any() and counts.any()
    frame, actual = results(device, case, pair_limit=int(counts.max()))
    assert len(frame.bands) > 2
    assert_same(expected, actual)
    assert np.allclose(actual[0][:, :32].T, case["background"])


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


def test_the_limit_follows_from_the_devices_memory(device, monkeypatch):
    """The indices, gradients and checkpoints of the pairs take a quarter of it."""
    monkeypatch.setattr(device, "largest_buffer", 1 << 60)
    limit = pair_limit(device, 61, 37, True)
    assert 0 < limit < PAIR_LIMIT
    each = 8 + sum(pair_reals(device, True)) * device.real.itemsize
    assert 0.24 < limit * each / device.handle.global_mem_size < 0.2505


def test_the_limit_leaves_room_in_the_largest_buffer(device, monkeypatch):
    """The pool rounds a size up by half at most; the group form's has a bucket a tile to spare."""
    monkeypatch.setattr(device, "largest_buffer", 1 << 20)
    limit = pair_limit(device, 61, 37, True)
    tiles = np.prod(tile_grid(device, 61, 37))
    reals = {"item": 10 * limit, "group": (limit / device.bucket + tiles) * device.tile**2 * 5}
    assert 0.66 < reals[device.form] * device.real.itemsize / (1 << 20) <= 2 / 3


def test_an_ordinary_frame_launches_and_waits_as_if_there_were_no_bands(device, monkeypatch):
    launched, waits, launch, download = [], [], device.launch, Array.download
    monkeypatch.setattr(device, "launch", lambda kernel, *arguments, **values: (
        launched.append(kernel.function), launch(kernel, *arguments, **values)))
    monkeypatch.setattr(Array, "download", lambda array: (
        waits.append(array.shape), download(array))[1])
    monkeypatch.setattr(Array, "last", None)
    case = cases.gaussians("degree_1")
    rendered_and_back(device, case)
    number = Counter(launched)
    assert number["count_tiles"] == 0
    assert waits == 2 * [(FRAME_COUNTS,)]  # visible gaussians, pairs
    for function in ("count_pairs", "place_pairs", "emit_pairs", "blend", "blend_adjoint"):
        assert number[function] == 1, function
    assert number["sum_pairs"] == 0


# --- memory


class ExactPool:
    """A device's pool that does not round sizes up, and remembers how much was taken at most."""

    def __init__(self, device):
        self.most = self.managed_bytes = 0
        allocator = cl.tools.ImmediateAllocator(device.queue)
        self._pool = cl.tools.MemoryPool(allocator, leading_bits_in_bin_id=20)

    def allocate(self, size, exact=False):
        buffer = self._pool.allocate(size)
        self.most = max(self.most, self._pool.active_bytes)
        return buffer


def test_bands_hold_no_more_than_the_largest_of_them(device, monkeypatch):
    """In one band, the frame takes more by what its other pairs need."""
    case = cases.gaussians(SPREAD, count=400)
    most = []
    for limit in (1300, 10**6):
        pool = ExactPool(device)
        monkeypatch.setattr(device, "_pool", pool)
        frame, _ = rendered_and_back(device, case, pair_limit=limit)
        most.append(pool.most)
    each = 8 + sum(pair_reals(device, True)) * device.real.itemsize
    others = frame.pairs.count - 1300
    assert others > 1300 and most[1] - most[0] > 0.9 * others * each


def test_memory_that_is_refused_is_an_error_of_its_own(float_device, monkeypatch):
    def refuse(size):
        raise cl.MemoryError("clCreateBuffer failed: MEM_OBJECT_ALLOCATION_FAILURE")

    monkeypatch.setattr(float_device, "_new_buffer", refuse)
    with pytest.raises(OutOfDeviceMemory, match="no memory for 3 MiB more.*--max-gaussians"):
        float_device.zeros((3 << 18,))


# --- the choice


@pytest.mark.parametrize("seed", range(20))
def test_bands_are_as_few_as_the_limit_allows(seed):
    rng = np.random.default_rng(seed)
    counts = rng.integers(0, 50, 200) * rng.integers(0, 2, 200)
    for limit in (50, 120, 2000, int(counts.sum())):
        bands = choose_bands(counts, limit)
        assert [tile for band in bands for tile in band] == list(range(200))
        sizes = [counts[band.start:band.stop].sum() for band in bands]
        assert max(sizes) <= limit
        assert all(size + counts[band.stop] > limit for size, band in zip(sizes, bands[:-1]))


def test_sums_past_32_bits():
    bands = choose_bands(np.full(10, 2**31 - 1), 2**32)
    assert bands == tuple(range(i, i + 2) for i in range(0, 10, 2))


def test_a_tile_above_the_limit_is_refused(device):
    with pytest.raises(DeviceError, match=r"31 pairs .* single tile, more than 30.*--max-gaus"):
        choose_bands(np.array([3, 31, 2]), 30)
    with pytest.raises(DeviceError, match="single tile, more than 0"):
        render(device, cases.gaussians(SPREAD), pair_limit=0)
