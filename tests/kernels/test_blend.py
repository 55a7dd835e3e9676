"""Blending and its adjoint by themselves: splats in, images and sums by splat out."""

import numpy as np
import pytest

from clsplat.camera import Camera
from clsplat.primitives.compact import new_counts
from clsplat.rendering import blend
from clsplat.rendering.bin import bin_splats
from clsplat.rendering.project import pack_camera, project_defines, sum_pairs
from tests import cases
from tests.checks import close
from tests.kernels.chain import SUM_NAMES, grads_of_sums, pack_splats, precision_of
from tests.reference import blend as reference
from tests.reference.exposure import NO_LENS, apply, radius

PLAIN_ARGUMENTS = {"item": 10, "group": 12}
BACKGROUND = np.array([0.25, 0.5, 0.875])


class Blended:
    """Splats blended on a device: image, transmittance, depth, and the adjoint."""

    def __init__(
        self,
        device,
        rows,
        size,
        background=BACKGROUND,
        with_depth=True,
        smooth=False,
        more=(),
        room=None,
        features=None,
    ):
        self.device, self.with_depth = device, with_depth
        self.defines = blend.blend_defines(with_depth, smooth) + more
        self.background = device.upload(np.asarray(background, float))
        self.splats = device.upload(rows)
        self.pairs = bin_splats(
            device,
            self.splats,
            new_counts(device, len(rows)),
            device.upload(np.arange(len(rows), dtype=np.uint32)),
            *size,
            room=room,
        )
        self.features = features and blend.Features(*map(device.upload, features))
        self.blended = blend.blend(
            device, self.splats, self.pairs, *size, self.background, self.defines, features=self.features
        )
        self.image = self.blended.image.download()
        self.transmittance = self.blended.transmittance.download()
        self.last_contributor = self.blended.last_contributor.download()
        self.depth = self.blended.depth.download() if with_depth else None

    def adjoint(self, grad_image, grad_depth=None, grad_transmittance=None):
        by_depth, by_transmittance = (
            self.device.upload(np.zeros(self.depth.shape) if grad is None else grad) if self.with_depth else None
            for grad in (grad_depth, grad_transmittance)
        )
        by_pair = blend.blend_adjoint(
            self.device,
            self.splats,
            self.pairs,
            self.blended,
            self.background,
            self.device.upload(grad_image),
            by_depth,
            by_transmittance,
            self.defines,
            features=self.features,
        )
        return sum_pairs(self.device, by_pair, self.pairs.counts, project_defines(0, False)).download()


def check(device, splats, order, size, what, with_depth=True, smooth=False):
    """Image and gradients by splat against the reference; returns the Blended."""
    width, height = size
    fragile = reference.fragile_pixels(splats, order, width, height)
    rng = np.random.default_rng(4)
    grad_image = np.where(fragile, 0, rng.normal(size=(3, height, width)))
    more = [np.where(fragile, 0, rng.normal(size=(height, width))) for _ in range(2 if with_depth else 0)]
    image, transmittance, depth = reference.blend(splats, order, width, height, BACKGROUND, smooth, with_depth)
    expected = reference.blend_adjoint(splats, order, width, height, BACKGROUND, grad_image, *more, smooth=smooth)

    precision = precision_of(device)
    actual = Blended(device, pack_splats(splats, order), size, BACKGROUND, with_depth, smooth)
    close(np.where(fragile, image, actual.image), image, precision, f"{what}: image")
    close(np.where(fragile, transmittance, actual.transmittance), transmittance, precision, f"{what}: transmittance")
    if with_depth:
        close(np.where(fragile, depth, actual.depth), depth, precision, f"{what}: depth")
    grads = grads_of_sums(actual.adjoint(grad_image, *more), splats["conics"][order])
    for name in SUM_NAMES:
        close(grads[name], expected[name][order], precision, f"{what}: gradient of {name}")
    assert fragile.mean() < 0.05, f"{what}: too little is compared"
    return actual


@pytest.mark.double
@pytest.mark.oclgrind
@pytest.mark.parametrize("size", cases.IMAGE_SIZES, ids=str)
def test_image_and_gradients(device, size):
    check(device, *cases.splats(40, *size), size, f"{size}")


@pytest.mark.slow  # PoCL compiles the group form for a quarter of a minute
@pytest.mark.oclgrind
@pytest.mark.parametrize("channels", [1, 3, 8])
@pytest.mark.parametrize("with_depth", [False, True])
@pytest.mark.one_in(5)
def test_features_of_any_number_of_channels(device, channels, with_depth):
    """In place of the colours of the splats, which are nan; of gaussians in another order."""
    size, rng = (37, 29), np.random.default_rng(channels)
    (splats, order), background = cases.splats(60, *size), cases.single(rng.random(channels))
    splats["colours"] = cases.single(rng.normal(size=(60, channels)))
    fragile, precision = reference.fragile_pixels(splats, order, *size), precision_of(device)
    image, transmittance, _ = reference.blend(splats, order, *size, background)
    grads = [np.where(fragile, 0, rng.normal(size=(*shape, 29, 37))) for shape in ((channels,), *[()] * 2 * with_depth)]
    expected = reference.blend_adjoint(splats, order, *size, background, *grads)

    places = rng.permutation(60).astype(np.uint32)
    features = np.zeros((60, channels))
    features[places] = splats["colours"][order]
    rows = pack_splats({**splats, "colours": np.full((60, 3), np.nan)}, order)
    actual = Blended(device, rows, size, background, with_depth, features=(features, places))
    close(np.where(fragile, image, actual.image), image, precision, "image")
    close(np.where(fragile, transmittance, actual.transmittance), transmittance, precision, "transmittance")
    sums = grads_of_sums(actual.adjoint(*grads), splats["conics"][order], channels)
    for name in SUM_NAMES if with_depth else SUM_NAMES[:-1]:
        close(sums[name], expected[name][order], precision, f"gradient of {name}")


@pytest.mark.oclgrind
@pytest.mark.parametrize("with_depth, vignetting", [(True, True), pytest.param(False, False, marks=pytest.mark.slow)])
@pytest.mark.parametrize("size", cases.IMAGE_SIZES, ids=str)
def test_the_response_of_a_view(device, size, with_depth, vignetting):
    """Its transform after the gain of its lens, beside the image, which stays as it is; those of
    other views differ."""
    rows = pack_splats(*cases.splats(40, *size))
    transforms = cases.single(np.random.default_rng(5).normal(0, 0.5, (3, 3, 4)))
    lenses = cases.single(np.array([[0.5, 0.5, 0.5, 1], [-0.3, 0.2, -0.4, 0.9]]))
    camera = Camera(*size, (0.9 * size[0], 1.1 * size[0]), (0.45 * size[0], 0.6 * size[1]), np.eye(3), np.zeros(3))
    plain = Blended(device, rows, size, with_depth=with_depth)
    lens = (
        (pack_camera(device, camera, 0.01), device.upload(np.array([0, 1, 0], np.uint32)), device.upload(lenses))
        if vignetting
        else ()
    )
    drawn = blend.blend(
        device,
        plain.splats,
        plain.pairs,
        *size,
        plain.background,
        plain.defines,
        exposure=blend.Exposure(device.upload(transforms.reshape(3, 12)), 1, *lens),
    )
    assert np.array_equal(drawn.image.download(), plain.image)
    own = lenses[1] if vignetting else NO_LENS
    close(
        drawn.exposed.download(),
        apply(transforms[1], plain.image, own, radius(camera, own)),
        precision_of(device),
        "exposed",
    )


@pytest.mark.parametrize("with_depth, smooth", [(False, False), (True, True)])
@pytest.mark.one_in(3)
def test_without_depth_and_with_a_smooth_cutoff(device, with_depth, smooth):
    check(device, *cases.splats(60, 48, 40, seed=1), (48, 40), "plain", with_depth, smooth)


@pytest.mark.oclgrind
def test_a_deep_faint_stack_crosses_batches_and_buckets(device):
    """All of more than 256 splats of one tile are blended, in two batches and many buckets."""
    splats, order = cases.splats(330, 17, 16, seed=2, opacity=(0.005, 0.02), sigma=(8, 30))
    actual = check(device, splats, order, (17, 16), "faint stack")
    assert actual.last_contributor[8, 8] > 256 and actual.transmittance.min() > 2e-4


@pytest.mark.parametrize("count", [15, 16, 17, 31, 32, 33, 255, 256, 257])
def test_lists_around_bucket_and_batch_sizes(device, count):
    splats, order = cases.splats(count, 16, 16, seed=count, opacity=(0.006, 0.02), sigma=(9, 30))
    splats["means"] = cases.single(8 + 0.2 * (splats["means"] - 8))
    actual = check(device, splats, order, (16, 16), f"{count} splats")
    assert actual.last_contributor.max() == count - 1


@pytest.mark.parametrize("height", [3, 4, 5, 13, 16, 18])
def test_splats_of_a_row_reach_their_blocks_of_rows_only(device, height):
    """Flat ellipses at every quarter of a pixel; the image may end within a block of 4 rows."""
    splats, order = cases.splats(72, 16, height, seed=11, sigma=(0.15, 0.4))
    splats["means"][:, 1] = cases.single(np.linspace(-0.5, 17.25, 72))
    check(device, splats, order, (16, height), f"{height} rows")


def test_blocks_of_rows_end_at_different_depths(device):
    """Opaque above, clear below: the upper rows end in an early chunk of pairs, others never."""
    splats, order = cases.splats(90, 16, 16, seed=12, opacity=(0.8, 0.99), sigma=(5, 7))
    splats["means"][:, 1] = -6
    actual = check(device, splats, order, (16, 16), "opaque above")
    ends = actual.last_contributor.max(axis=1)
    assert ends[:4].max() < 80 and (ends[-4:] == len(order) - 1).all()
    assert actual.transmittance[-4:].min() > 1e-3


def test_alpha_is_clamped_at_its_limit(device):
    """In the middle; further out the same splat is below the clamp and has a gradient."""
    splats, order = cases.splats(2, 16, 16, seed=5, sigma=(8, 12))
    splats["means"][:], splats["opacities"][:] = 8, cases.single([0.9999, 0.6])
    actual = check(device, splats, order, (16, 16), "saturated")
    assert np.allclose(actual.transmittance[8, 8], 0.01 * 0.4, rtol=0.02)


def test_a_build_has_the_arguments_of_its_choices_alone(float_device):
    plain, deep = (blend.BLEND.contract(float_device, (("WITH_DEPTH", deep),)) for deep in (0, 1))
    assert len(plain.arguments) == PLAIN_ARGUMENTS[float_device.form]
    more = {"depth", "depth_checkpoints"} if float_device.form == "group" else {"depth"}
    assert deep.arguments.keys() - plain.arguments.keys() == more


def test_nothing_leaves_the_background(device):
    actual = Blended(device, np.zeros((0, 12)), (33, 17))
    assert (actual.image == BACKGROUND[:, None, None]).all()
    assert (actual.transmittance == 1).all() and (actual.last_contributor == -1).all()
    assert (actual.depth == 0).all()
    assert actual.adjoint(np.ones((3, 17, 33)), *np.ones((2, 17, 33))).shape == (0, 10)


SIZES = [(32, 32, 32), (32, 128, 64), (64, 64, 64), (64, 64, 128)]


@pytest.mark.parametrize("wave, bucket, adjoint_group", SIZES)
@pytest.mark.parametrize("count", [31, 64, 65, 129])
@pytest.mark.slow
@pytest.mark.one_in(6)
def test_sizes_of_waves_buckets_and_groups(group_device, monkeypatch, wave, bucket, adjoint_group, count):
    """The last bucket and the last three splats that are summed together are full or not."""
    with_sizes(group_device, monkeypatch, wave, bucket, adjoint_group)
    splats, order = cases.splats(count, 16, 16, seed=count, opacity=(0.006, 0.02), sigma=(2, 30))
    splats["means"] = cases.single(8 + 0.5 * (splats["means"] - 8))
    check(group_device, splats, order, (16, 16), f"{count} splats")


@pytest.mark.parametrize("tile", [8, pytest.param(16, marks=pytest.mark.oclgrind)])
@pytest.mark.parametrize("wave, bucket, adjoint_group", SIZES)
@pytest.mark.one_in(6)
def test_sizes_give_the_same_image(group_device, monkeypatch, wave, bucket, adjoint_group, tile):
    splats, order = cases.splats(150, 37, 29, seed=11, opacity=(0.05, 0.95))
    rows = pack_splats(splats, order)
    expected = Blended(group_device, rows, (37, 29))
    cotangent = np.random.default_rng(11).normal(size=(3, 29, 37)), np.ones((29, 37))
    expected_sums = expected.adjoint(*cotangent)
    with_sizes(group_device, monkeypatch, wave, bucket, adjoint_group, tile)
    actual = Blended(group_device, rows, (37, 29))
    assert np.array_equal(actual.image, expected.image)
    assert np.array_equal(actual.depth, expected.depth)
    close(actual.adjoint(*cotangent), expected_sums, precision_of(group_device), "sums")


def with_sizes(device, monkeypatch, wave, bucket, adjoint_group, tile=16):
    if precision_of(device) == "double" and bucket < 128:
        pytest.skip("double precision: with the sizes that take most local memory")
    for name, size in {
        "wave": wave,
        "bucket": bucket,
        "tile": tile,
        "adjoint_group": min(adjoint_group, tile**2),
    }.items():
        monkeypatch.setattr(device, name, size)


@pytest.mark.slow
@pytest.mark.parametrize("wave", [32, 64])
@pytest.mark.parametrize("kind", ["specks", "needles", "edges", "giants"])
def test_sub_tiles_that_are_skipped_have_nothing_to_draw(group_device, monkeypatch, kind, wave):
    """The same bytes as without masks: for splats within a sub-tile, across many, and with an end
    of the ellipse within a hundredth of a pixel of pixel centres at the edge of a sub-tile."""
    monkeypatch.setattr(group_device, "wave", wave)
    monkeypatch.setattr(group_device, "adjoint_group", wave)
    rows = sub_tile_rows(kind)
    cotangent = np.random.default_rng(12).normal(size=(3, 37, 61)), np.ones((37, 61))
    masked, plain = (Blended(group_device, rows, (61, 37), more=more) for more in ((), (("SUBTILE_MASK", 0),)))
    assert np.array_equal(masked.image, plain.image)
    assert np.array_equal(masked.depth, plain.depth)
    assert np.array_equal(masked.last_contributor, plain.last_contributor)
    assert np.array_equal(masked.adjoint(*cotangent), plain.adjoint(*cotangent))


def sub_tile_rows(kind):
    """Rows of splats, real[400, 12]."""
    rng = np.random.default_rng(12)
    sigma = {"specks": (0.3, 1), "needles": (0.3, 1), "edges": (1, 2), "giants": (20, 90)}[kind]
    splats, order = cases.splats(400, 61, 37, seed=12, opacity=(0.05, 0.6), sigma=sigma)
    if kind == "needles":
        angle = rng.uniform(0, np.pi, 400)
        across = np.stack([-np.sin(angle), np.cos(angle)], 1)
        wide = across[:, :, None] * across[:, None] / 0.6**2
        along = (np.eye(2) - across[:, :, None] * across[:, None]) / 12**2
        splats["conics"] = cases.single(np.stack([(wide + along)[:, i, j] for i, j in ((0, 0), (0, 1), (1, 1))], 1))
    rows = pack_splats(splats, order)
    if kind == "edges":  # the right, left, lower or upper end at a pixel centre beside an edge
        a, b, c = rows[:, 4:7].T
        extent = np.stack([np.sqrt(rows[:, 3] * c / (a * c - b * b)), rows[:, 7]])
        edge = np.stack([8 * rng.integers(0, 8, 400), 4 * rng.integers(0, 9, 400)])
        side = rng.choice([-1, 1], (2, 400))
        rows[:, :2] = (edge + 0.5 * side - side * extent + rng.uniform(-0.01, 0.01, (2, 400))).T
    return rows


def test_nothing_is_read_that_was_not_written(group_device, monkeypatch):
    """Checkpoints of ended pixels and of buckets behind them are left out."""
    splats, order = cases.splats(400, 20, 16, seed=3, opacity=(0.3, 0.9999), sigma=(6, 30))
    rows = pack_splats(splats, order)
    cotangent = np.random.default_rng(14).normal(size=(3, 16, 20)), np.ones((16, 20))
    expected = Blended(group_device, rows, (20, 16)).adjoint(*cotangent)
    empty = group_device.empty

    def poisoned(shape, dtype=None):
        array = empty(shape, dtype)
        if array.dtype.kind == "f":
            array.write(np.full(array.shape, np.nan))
        return array

    monkeypatch.setattr(group_device, "empty", poisoned)
    assert np.array_equal(Blended(group_device, rows, (20, 16)).adjoint(*cotangent), expected)
