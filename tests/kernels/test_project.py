"""Gaussians to splats and the adjoint by themselves: splats, keys, gradients of random sums."""

import functools

import numpy as np
import pytest

from clsplat.constants import NO_ROW
from clsplat.primitives.compact import compact, new_counts
from clsplat.primitives.sort import stable_sort
from clsplat.rendering.bin import bin_splats
from clsplat.rendering.blend import SplatGrads, pair_columns
from clsplat.rendering.cull import cull
from clsplat.rendering.project import pack_camera, project, project_adjoint
from tests import cases
from tests.checks import close
from tests.kernels import chain
from tests.reference import project as reference

ANTIALIASED = ("degree_0", "plain", "needles", "opacities", "specks")
CASES = [(name, False) for name in cases.SCENES] + [(name, True) for name in ANTIALIASED]


def one_pair_each(device, sums):
    """SplatGrads of splats with one pair."""
    numbers = np.arange(len(sums), dtype=np.uint32)
    return grads_of_pairs(device, sums, np.ones_like(numbers), numbers)


def grads_of_pairs(device, sums, counts, offsets):
    """With or without the sum of the depth channel."""
    return SplatGrads(
        device.upload(sums),
        device.upload(counts),
        device.upload(offsets),
        (("WITH_DEPTH", int(sums.shape[1] > pair_columns(3, False))),),
    )


def many_pairs_each(device, first):
    """SplatGrads of splats with 0, 1, 2, ... further pairs after a `first` one, and those whose one
    pair has their sums, added up in the order of pairs in the device's precision."""
    counts = 1 + np.arange(len(first), dtype=np.uint32)
    offsets = np.cumsum(counts, dtype=np.uint32) - counts
    values = np.random.default_rng(4).normal(size=(counts.sum(), first.shape[1]))
    values = values.astype(device.real)
    values[offsets] = first
    sums = np.array([functools.reduce(np.add, values[begin : begin + count]) for begin, count in zip(offsets, counts)])
    return grads_of_pairs(device, values, counts, offsets), one_pair_each(device, sums)


class Projected:
    """A case through cull, project and its adjoint; everything downloaded, by row."""

    def __init__(self, device, case, antialiased=False, with_depth=True, splat_grads=one_pair_each, with_pose=False):
        defines = (("SH_REST", case["rows"]["sh_rest"].shape[1]), ("ANTIALIASED", int(antialiased)))
        rows = chain.upload_rows(device, case["rows"])
        camera = pack_camera(device, chain.camera_of(case), case["near"])
        counts = new_counts(device)
        flags, totals = cull(device, rows, camera, defines)
        seen = compact(device, flags, counts, totals=totals)
        self.visible = seen.download()
        splats, keys = project(device, rows, seen, counts, camera, case["degree"], defines)
        self.splats, self.keys = splats.download(), keys.download()
        self.sums = cases.single(np.random.default_rng(3).normal(size=(len(self.visible), 9 + with_depth)))
        self.skipped = device.zeros(1, np.uint32)
        gradients = project_adjoint(
            device,
            rows,
            seen,
            counts,
            camera,
            case["degree"],
            defines,
            splat_grads(device, self.sums),
            self.skipped,
            with_pose=with_pose,
        )
        self.pose_terms = gradients.pose_terms.download() if with_pose else None
        self.active, self.grad_means = gradients.rows.download(), gradients.means.download()
        self.gradients = {}
        for name, values in case["rows"].items():
            self.gradients[name] = np.zeros(values.shape)
            downloaded = gradients.fields[name].download()
            if name == "sh_rest":
                downloaded[:, case["degree"] * (case["degree"] + 2) :] = 0
            self.gradients[name][self.visible] = downloaded


def check(device, case, antialiased, what, with_depth=True):
    arguments = case["camera"], case["degree"], case["near"]
    expected = reference.project(case["rows"], *arguments, antialiased=antialiased)
    actual = Projected(device, case, antialiased, with_depth)
    visible, precision = actual.visible, chain.precision_of(device)
    assert np.array_equal(visible, np.flatnonzero(expected["visible"])), f"{what}: visible"
    conics = expected["conics"][visible]
    close(actual.keys.view(np.float32), expected["depths"][visible], "float", f"{what}: depth keys")
    parts = {"means": slice(0, 2), "opacities": 2, "cutoffs": 3, "colours": slice(8, 11), "depths": 11}
    for name, columns in parts.items():
        close(actual.splats[:, columns], expected[name][visible], precision, f"{what}: {name}")
    close(actual.splats[:, 7], expected["extents"][visible, 1], precision, f"{what}: extents")
    # each conic by its own size: those of needles and specks differ by many orders
    size = np.abs(conics).max(axis=1, keepdims=True)
    close(actual.splats[:, 4:7] / size, conics / size, precision, f"{what}: conics")

    by_splat = chain.grads_of_sums(actual.sums, conics)
    grads = {name: np.zeros((len(expected["visible"]), *values.shape[1:])) for name, values in by_splat.items()}
    for name, values in by_splat.items():
        grads[name][visible] = values
    close(actual.grad_means, by_splat["means"], precision, f"{what}: gradient of means")
    chain.close_gradients(
        actual.gradients,
        reference.project_adjoint(case["rows"], *arguments, antialiased=antialiased, grads=grads),
        case,
        precision,
        what,
    )
    assert np.array_equal(actual.active, visible) and actual.skipped.download()[0] == 0, what


@pytest.mark.double
@pytest.mark.parametrize("name, antialiased", CASES)
@pytest.mark.one_in(5)
def test_splats_and_gradients(device, name, antialiased):
    check(device, cases.gaussians(name), antialiased, name)


@pytest.mark.oclgrind
def test_counts_around_the_group_size(device):
    group = device.group_size
    for count in (0, 1, group - 1, group, group + 1, 3 * group + 7):
        check(device, cases.gaussians("degree_1", count=count), False, f"{count} gaussians")


def test_without_the_depth_sum_nothing_flows_to_depth(device):
    """Nine sums a row instead of ten, read with the right stride."""
    check(device, cases.gaussians("degree_1", seed=1), False, "nine sums", with_depth=False)


def test_any_sum_that_is_not_finite_leaves_its_row_and_the_pose_alone(float_device):
    """The sum of each column is infinite of one splat."""

    def spoilt(device, sums):
        np.fill_diagonal(sums, np.inf)
        return one_pair_each(device, sums)

    case = cases.gaussians("degree_0", count=70)
    actual = Projected(float_device, case, splat_grads=spoilt, with_pose=True)
    columns = actual.sums.shape[1]
    assert (actual.active[:columns] == NO_ROW).all() and actual.skipped.download()[0] == columns
    assert np.array_equal(actual.active[columns:], actual.visible[columns:])
    assert not actual.pose_terms[:columns].any() and actual.pose_terms[columns:].all()


@pytest.mark.parametrize("with_depth", [True, False])
def test_sums_over_pairs_are_added_in_their_order(device, with_depth):
    """However many there are, so that the bytes in bands and in one piece are the same."""
    case = cases.gaussians("degree_0", count=70)
    pairs, sums = (
        Projected(device, case, False, with_depth, lambda *made: many_pairs_each(*made)[which])  # noqa: B023
        for which in (0, 1)
    )
    for field, values in pairs.gradients.items():
        assert np.array_equal(values, sums.gradients[field]), field


def test_a_gaussian_that_cannot_be_drawn_has_no_tiles(device):
    """Its parameters may have changed since it was culled."""
    case = cases.gaussians("degree_1", count=20)
    case["rows"]["opacity_logits"][3] = -20
    case["rows"]["positions"][5] = np.nan
    case["rows"]["log_scales"][7] = 500
    defines = (("SH_REST", 3), ("ANTIALIASED", 0))
    counts, seen = new_counts(device, 20), device.upload(np.arange(20, dtype=np.uint32))
    splats, keys = project(
        device,
        chain.upload_rows(device, case["rows"]),
        seen,
        counts,
        pack_camera(device, chain.camera_of(case), case["near"]),
        case["degree"],
        defines,
    )
    assert np.isfinite(splats.download()).all() and not keys.download()[[3, 5, 7]].any()
    order = stable_sort(device, keys, counts)[1]
    pairs = bin_splats(device, splats, counts, order, *chain.size_of(case))
    assert not pairs.splat_counts.download()[[3, 5, 7]].any() and pairs.count > 20


def test_slots_past_the_visible_gaussians_are_not_touched(device):
    """A room for more than there are: the same splats and gradients, and nothing behind them."""
    case = cases.gaussians("degree_1", count=60)
    exact = Projected(device, case)
    number, room = len(exact.visible), len(exact.visible) + 13
    defines = (("SH_REST", 3), ("ANTIALIASED", 0))
    rows = chain.upload_rows(device, case["rows"])
    camera = pack_camera(device, chain.camera_of(case), case["near"])
    counts = new_counts(device, number)
    seen = device.upload(np.resize(exact.visible, room).astype(np.uint32))
    splats, keys = project(device, rows, seen, counts, camera, case["degree"], defines)
    assert np.array_equal(splats.download()[:number], exact.splats)
    assert np.array_equal(keys.download()[:number], exact.keys)
    sums = one_pair_each(device, np.resize(exact.sums, (room, exact.sums.shape[1])))
    skipped, empty, made = device.zeros(1, np.uint32), device.empty, []

    def noted(shape, dtype=None):
        made.append(empty(shape, dtype))
        made[-1].fill(77)
        return made[-1]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(device, "empty", noted)
        gradients = project_adjoint(device, rows, seen, counts, camera, case["degree"], defines, sums, skipped)
    assert len(made) == 8 and all((array.download()[number:] == 77).all() for array in made)
    assert np.array_equal(gradients.rows.download()[:number], exact.active)
    assert np.array_equal(gradients.means.download()[:number], exact.grad_means)
    for name, values in gradients.fields.items():
        assert np.array_equal(values.download()[:number], exact.gradients[name][exact.visible].astype(device.real)), (
            name
        )
