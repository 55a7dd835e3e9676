"""Lazy dense Adam against dense Adam step by step: what rows miss while no view sees them."""

import numpy as np
import pytest

from clsplat.camera import Camera
from clsplat.constants import ADAM_EPSILON, CATCH_UP_EVERY, LAZY_TERMS, NO_ROW, SH_C0
from clsplat.gaussians import LEARNED
from clsplat.optimise.adam import DeviceAdam
from clsplat.optimise.rates import corrections
from clsplat.primitives.compact import new_counts
from clsplat.rendering.cull import cull
from clsplat.rendering.project import FieldGradients, Gradients, pack_camera
from tests.kernels.chain import precision_of
from tests.kernels.test_adam import take_step
from tests.reference.adam import adam
from tests.reference.project import harmonics

DEGREE = 2
K = DEGREE * (DEGREE + 2)
RATES = {
    "positions": 3e-3,
    "sh_constant": 4e-3,
    "sh_rest": 1e-3,
    "opacity_logits": 2e-2,
    "log_scales": 5e-3,
    "quaternions": 2e-3,
}
USED = {field.name: field.width(DEGREE) for field in LEARNED}
# of the accumulated movement of an element, and of its moments
BOUND = {"float": 1e-5, "double": 1e-10}
DEFINES = (("SH_REST", K), ("ANTIALIASED", 0))


def flat(values):
    return values.reshape(len(values), -1)


class Lazy:
    """Gaussians around cameras that turn at random, an engine that is lazy, and every step of dense
    Adam in float64 by the reference."""

    def __init__(self, device, count=70, seed=0):
        rng = self.rng = np.random.default_rng(seed)
        rows = {field.name: rng.normal(size=(count, *field.row_shape(DEGREE))) for field in LEARNED}
        rows["positions"] *= 3
        rows["log_scales"] -= 3
        self.expected = {n: v.astype(np.float32).astype(float) for n, v in rows.items()}
        self.first, self.second, self.moved = ({name: np.zeros(v.shape) for name, v in rows.items()} for _ in range(3))
        self.device, self.count, self.steps, self.frozen = device, count, 0, None
        self.rows = {name: device.upload(values) for name, values in self.expected.items()}
        self.engine = DeviceAdam(device, self.rows)

    def camera(self):
        """One that looks anywhere from the middle, at a sixth of the sphere."""
        turn, _ = np.linalg.qr(self.rng.normal(size=(3, 3)))
        turn *= np.linalg.det(turn)
        return pack_camera(self.device, Camera(60, 40, (40.0, 40.0), (30.0, 20.0), turn, np.zeros(3)), 0.1)

    def current(self):
        """All rows after the last step, as copies."""
        return self.engine.current(self.rows, self.device.upload(np.arange(self.count, dtype=np.uint32)), self.frozen)

    def seen(self):
        """The rows that the next camera sees; they have caught up, and nothing else has changed
        what is seen."""
        camera = self.camera()
        numbers = self.engine.numbers(self.steps + 1, RATES)
        self.engine.catch_up_seen(self.rows, numbers, DEGREE, self.frozen, camera, new_counts(self.device))
        flags, _ = cull(self.device, self.rows, camera, DEFINES)
        current, _ = cull(self.device, self.current(), camera, DEFINES)
        seen = np.flatnonzero(flags.download()).astype(np.uint32)
        assert np.array_equal(seen, np.flatnonzero(current.download()))
        last = self.engine.lag()["last_step"]
        assert self.frozen is not None or (last[seen] == self.engine.steps).all()
        return seen

    def step(self, used=USED, by_colour=True):
        """On random gradients of a view, every seventh of which is not finite."""
        visible = self.seen()
        self.steps += 1
        rates = {**RATES, "positions": RATES["positions"] * 0.99**self.steps}
        count, rng = len(visible), self.rng
        fields = {field.name: rng.normal(size=(count, *field.row_shape(DEGREE))) for field in LEARNED}
        colours, directions = rng.normal(size=(2, count, 3))
        directions /= np.linalg.norm(directions, axis=1, keepdims=True)
        if by_colour:
            fields["sh_constant"] = SH_C0 * colours
            fields["sh_rest"] = harmonics(directions, DEGREE)[0][:, 1:, None] * colours[:, None]
        broken = rng.random(count) < 1 / 7
        stays = np.zeros(self.count, bool)
        stays[visible[broken]] = True
        if self.frozen is not None:
            stays |= self.frozen.download() > 0
        for name, values in fields.items():
            values[broken] = 0
            spread = np.zeros_like(self.expected[name])
            spread[visible] = values
            columns, before = slice(0, used[name]), self.expected[name]
            results = adam(
                *(flat(a)[:, columns] for a in (before, spread, self.first[name], self.second[name])),
                self.steps,
                rates[name],
                ~stays,
            )
            self.expected[name] = before.copy()
            for target, values in zip((self.expected, self.first, self.second), results):
                flat(target[name])[:, columns] = values
            self.moved[name] += np.abs(self.expected[name] - before)
        for values in (*fields.values(), colours):
            values[broken] = np.nan
        upload = self.device.upload
        rows = np.where(stays[visible], NO_ROW, visible).astype(np.uint32)
        counts = new_counts(self.device, count)
        stored = {name: upload(values) for name, values in fields.items()}
        if by_colour:
            for name in ("sh_constant", "sh_rest"):
                del stored[name]
            stored = FieldGradients(
                stored,
                upload(colours),
                upload(directions),
                K,
                (("SH_REST", K), ("ANTIALIASED", 0), ("DEGREE", DEGREE)),
                counts,
            )
        gradients = Gradients(stored, None, upload(rows), upload(visible), counts)
        take_step(self.engine, self.rows, gradients, self.steps, rates, used, self.frozen)

    def check(self, rows):
        bound, single = BOUND[precision_of(self.device)], np.finfo(self.device.real).eps
        for name, array in rows.items():
            off = np.abs(array.download() - self.expected[name])
            allowed = bound * self.moved[name] + 20 * single * np.abs(self.expected[name])
            assert (off <= allowed).all(), (name, (off / allowed).max())

    def check_moments(self):
        self.engine.catch_up(self.rows, self.frozen)
        self.check(self.rows)
        bound = BOUND[precision_of(self.device)]
        for moments, expected in zip(self.engine.download(), (self.first, self.second)):
            for name, values in moments.items():
                scale = np.abs(expected[name]).max(axis=0)  # a moment may cancel
                assert (np.abs(values - expected[name]) <= bound * scale).all(), name


@pytest.mark.parametrize("by_colour", [True, False])
@pytest.mark.one_in(4)
def test_lazy_rows_come_to_what_dense_adam_does_in_every_step(device, by_colour):
    """Over rounds of catching up, a growing degree and a position rate that falls; the rows may be
    looked at in between, which changes nothing."""
    run, rounds = Lazy(device), 2 if by_colour else 1
    for step in range(1, rounds * CATCH_UP_EVERY + 31):
        run.step({**USED, "sh_rest": 9} if step < 130 else USED, by_colour)
        if step in (1, 2, 57, CATCH_UP_EVERY - 1, CATCH_UP_EVERY, 212):
            before = {name: array.download() for name, array in run.rows.items()}
            run.check(run.current())
            assert all(np.array_equal(run.rows[name].download(), values) for name, values in before.items())
    lag = run.steps - run.engine.lag()["last_step"]
    assert lag.min() == 0 and lag.max() == 30
    run.check_moments()
    assert (run.engine.lag()["last_step"] == run.steps).all()


@pytest.mark.parametrize("by_position, by_scale", [(0.03, 0.0), (0.0, 0.1)])
def test_rows_that_will_be_seen_catch_up_however_far_they_coast(float_device, by_position, by_scale):
    """With moments as large as gradients can make them, in front of a camera of a wide angle."""
    count, missed, rng = 20_000, 20, np.random.default_rng(0)
    camera = pack_camera(float_device, Camera(64, 48, (12.0, 12.0), (32.0, 24.0), np.eye(3), np.zeros(3)), 0.1)
    rows = {field.name: np.ones((count, *field.row_shape(DEGREE))) for field in LEARNED}
    depth = rng.uniform(0.05, 4, count)
    rows["positions"] = np.column_stack([depth, depth, np.ones(count)]) * np.column_stack(
        [rng.uniform(-4, 4, (count, 2)), depth]
    )
    rows["log_scales"] = np.repeat(rng.uniform(-5, 0, (count, 1)), 3, axis=1)
    rows["opacity_logits"] += 9  # a large footprint
    rows = {name: float_device.upload(values) for name, values in rows.items()}
    engine = DeviceAdam(float_device, rows)
    roots = {field.name: np.ones((count, *field.row_shape(DEGREE))) for field in LEARNED}
    engine.upload({name: 7.2 * rng.choice((-1, 1), values.shape) for name, values in roots.items()}, roots)
    # C of each field, and C and D of a rate of 1
    coefficients = np.tile([by_position, 0, 0, 0, by_scale, 0, 1, 1], (CATCH_UP_EVERY, 1))
    assert coefficients.shape[1] == LAZY_TERMS
    engine.load_lag({"last_step": np.zeros(count, np.uint32), "coefficients": coefficients, "is_current": [0]}, missed)
    stale, seen = (
        cull(float_device, given, camera, DEFINES)[0].download() > 0
        for given in (rows, engine.current(rows, float_device.upload(np.arange(count, dtype=np.uint32))))
    )
    engine.catch_up_seen(rows, engine.numbers(missed + 1, RATES), DEGREE, None, camera, new_counts(float_device))
    moved = engine.lag()["last_step"] == missed
    assert moved[seen].all() and (seen & ~stale).sum() > 100
    assert not moved.all()  # or nothing is gained


@pytest.mark.oclgrind
def test_frozen_rows_do_not_catch_up(device):
    run = Lazy(device, count=device.group_size + 5)
    for _ in range(6):
        run.step()
    run.engine.catch_up(run.rows)
    frozen = np.arange(run.count) % 3 == 0
    run.frozen = device.upload(frozen.astype(np.uint32))
    before = run.rows["positions"].download()
    for _ in range(6):
        run.step()
    run.check_moments()
    assert np.array_equal(run.rows["positions"].download()[frozen], before[frozen])
    run.frozen = None
    for _ in range(6):
        run.step()
    run.check_moments()


def coasted(device, begun, missed, scale):
    """A row with one gradient of a size in step `begun`, and then none, by the engine and by
    the reference: how far it goes afterwards."""
    run = Lazy(device, count=1)
    for name in run.expected:
        run.expected[name][:] = 0
        run.rows[name].fill(0)
    m, v = (
        {name: np.full(values.shape, value) for name, values in run.expected.items()}
        for value in (0.1 * scale, 0.001 * scale**2)
    )
    run.engine.upload(m, v)
    nothing = Gradients(
        {field.name: device.empty((0, *field.row_shape(DEGREE))) for field in LEARNED},
        None,
        device.empty(0, np.uint32),
        device.empty(0, np.uint32),
        new_counts(device),
    )
    run.engine.load_lag({**run.engine.lag(), "last_step": np.array([begun], np.uint32)}, begun)
    expected = run.expected["opacity_logits"]
    m, v = m["opacity_logits"], v["opacity_logits"]
    for step in range(begun + 1, begun + missed + 1):
        expected, m, v = adam(expected, np.zeros(1), m, v, step, RATES["opacity_logits"])
        take_step(run.engine, run.rows, nothing, step, RATES, USED)
    run.engine.catch_up(run.rows)
    return run.rows["opacity_logits"].download()[0], expected[0]


@pytest.mark.parametrize("scale", [1e6, 1.0, 1e-9, 1e-12, 1e-13, 3e-14, 1e-14, 1e-15, 1e-17])
@pytest.mark.parametrize("begun, missed", [(1, 3), (3, 80), (100, 99), (301, 98), (3000, 100)])
@pytest.mark.one_in(5)
def test_epsilon_counts_as_far_as_stated(double_device, scale, begun, missed):
    """See cl/adam.cl."""
    actual, expected = coasted(double_device, begun, missed, scale)
    k = np.arange(1, missed + 1)
    c1, c2 = np.transpose([corrections(begun + i) for i in k])
    each = 1 / (c2 * 0.999 ** (k / 2) * np.sqrt(0.001) * scale)
    weight = c1 * each * 0.9**k
    mean = np.average(each, weights=weight)
    spread = np.average((each / mean - 1) ** 2, weights=weight)
    x = ADAM_EPSILON * mean
    bound = spread * (x / (1 + x)) ** 2 + 1e-12
    assert abs(actual - expected) <= bound * abs(expected), (actual / expected - 1, bound)
    assert spread < {1: 0.03, 3: 0.14, 100: 3e-3, 301: 4e-4, 3000: 3e-5}[begun]
