"""A training whose harmonics are paged beside one that has room: the same bytes."""

import numpy as np
import pytest

from clsplat.camera import Camera
from clsplat.constants import CATCH_UP_EVERY, PAGE_ROWS
from clsplat.densify.grow import Growth
from clsplat.errors import OutOfDeviceMemory, TooFewPages
from clsplat.gaussians import LEARNED, Gaussians
from clsplat.options import TrainOptions
from clsplat.rendering.pipeline import Renderer
from clsplat.schedule.plan import Plan
from clsplat.training import model as models
from clsplat.training.current import CurrentRenderer
from clsplat.training.model import Model
from clsplat.training.part import TrainingSample
from clsplat.training.parts.image_term import ImageTerm
from clsplat.training.step import Step

DEGREE, COUNT, WIDTH, HEIGHT, VIEWS = 1, 6 * PAGE_ROWS - 50, 40, 24, 7


def row_of_gaussians(count=COUNT):
    """Gaussians along 60 units, of which a camera sees about an eighth."""
    rng = np.random.default_rng(0)
    rows = {f.name: rng.normal(size=(count, *f.row_shape(DEGREE))) for f in LEARNED}
    rows["positions"] *= 0.5, 0.5, 0.1
    rows["positions"][:, 0] = rng.uniform(0, 60, count)
    rows["log_scales"] = rows["log_scales"] * 0.2 - 4
    return Gaussians({name: values.astype(np.float32) for name, values in rows.items()}, DEGREE)


class Run:
    """A training of these gaussians, with so many pages on the device at a time, or all of them."""

    def __init__(self, device, monkeypatch, room, engine="device", batch=1, count=COUNT):
        self.device, self.batch = device, batch
        with monkeypatch.context() as patch:
            if room:
                patch.setattr(
                    Model, "_free_bytes", lambda model: room * model.pages.store.page_bytes if model.pages else 0
                )
            self.model = Model(device, row_of_gaussians(count), engine)
        if room:  # in later rounds, too
            pages = self.model.pages
            pages._free = lambda: room * pages.store.page_bytes
        self.renderer = Renderer(device, DEGREE, 0.1)
        self.step = Step(self.renderer, self.model, 1.0, 1e-3, TrainOptions(iterations=300, batch=batch), [ImageTerm()])
        self.cameras = [self.renderer.pack(self.camera(view)) for view in range(VIEWS)]
        photos = np.random.default_rng(1).integers(0, 256, (VIEWS, 3, HEIGHT, WIDTH), np.uint8)
        self.photos, self.taken = [device.upload(photo) for photo in photos], 0

    @staticmethod
    def camera(view):
        return Camera(WIDTH, HEIGHT, (30.0, 30.0), (20.0, 12.0), np.eye(3), np.array([-4 - 8.5 * view, 0.0, 5.0]))

    def view_of(self, number):
        return 5 * number % VIEWS

    def take(self, steps, degree=DEGREE):
        plan = Plan(1.0, degree, gathers=True, grows=False, resets_opacity=False, prunes_large=False, decay=0.5)
        for _ in range(steps):
            numbers = range(self.taken * self.batch + 1, (self.taken + 1) * self.batch + 1)
            self.taken += 1
            self.step.run(
                self.taken,
                plan,
                [
                    TrainingSample(view, self.cameras[view], self.photos[view], number=number)
                    for number in numbers
                    for view in [self.view_of(number)]
                ],
                self.upcoming,
            )

    def upcoming(self, number):
        return self.view_of(number), self.cameras[self.view_of(number)]

    def arrays(self):
        """All that a checkpoint has, and the rows after the last step; some rows are theirs."""
        model, some = self.step.model, np.arange(1, self.step.model.count, 7)
        m, v = model.adam.download()
        for one, other in zip((model.stored(), m, v), (model.stored(some), *model.adam.download(some))):
            check_same({name: values[some] for name, values in one.items()}, other)
        kinds = {
            "row": model.stored(),
            "current": model.download().rows,
            "m": m,
            "v": v,
            "lag": model.adam.lag(),
            "statistics": {"sum": self.step.statistics.grad_norm_sum.download()},
        }
        return {f"{kind}.{name}": values for kind, found in kinds.items() for name, values in found.items()}

    def image(self, view):
        packed = self.renderer.pack(self.camera(view))
        frame = CurrentRenderer(self.renderer).render(self.step.model, packed, WIDTH, HEIGHT, DEGREE)
        return frame.image.download()


def check_same(one, other):
    assert one.keys() == other.keys()
    for name, values in one.items():
        assert np.array_equal(values, other[name]), name


@pytest.mark.slow
@pytest.mark.parametrize(
    "engine, batch", [("device", 1), ("coded", 1), pytest.param("device", 2, marks=pytest.mark.nightly)]
)
@pytest.mark.one_in(6)
def test_bytes_do_not_depend_on_the_room(float_device, monkeypatch, engine, batch):
    """Over steps without harmonics, rounds of catching up, growth, and looks at the model."""
    results, images, made_anew = [], [], []
    leave = models.Pages.leave_for_more
    monkeypatch.setattr(
        models.Pages, "leave_for_more", lambda pages: (made_anew.append(leave(pages)), made_anew[-1])[1]
    )
    for room in (0, 3 if batch == 1 else 4):
        run = Run(float_device, monkeypatch, room, engine, batch)
        assert (run.model.pages is not None) == (room > 0)
        run.take(5, degree=0)
        run.take(CATCH_UP_EVERY // 2)
        images.append([run.image(view) for view in range(VIEWS)])
        middle = run.arrays()
        rng = np.random.default_rng(2)
        source = np.concatenate([np.delete(np.arange(COUNT), slice(0, 2000, 3)), rng.choice(COUNT, 900)]).astype(
            np.uint32
        )
        kept = COUNT - 667
        run.step.replace_rows(
            Growth(
                source,
                kept,
                0,
                0,
                0,
                {
                    "positions": (kept, rng.normal(size=(900, 3)).astype(np.float32)),
                    "sh_rest": (kept, rng.normal(size=(900, 3, 3)).astype(np.float32)),
                },
            )
        )
        run.take(CATCH_UP_EVERY // 2 + 7)
        results.append({**run.arrays(), **{f"middle.{n}": each for n, each in middle.items()}})
        if room:
            assert run.model.pages.room == room < run.model.pages.pages
    check_same(*results)
    assert np.array_equal(*images)
    assert results[0]["m.sh_rest"].any() and any(made_anew)


@pytest.mark.slow
def test_a_page_that_nobody_asked_for_is_fetched_after_all(item_device, monkeypatch):
    """The frame fails and is repeated, with those that follow it."""
    whole, paged = Run(item_device, monkeypatch, 0), Run(item_device, monkeypatch, 3)
    look_ahead, room_made, repeated = paged.model.look_ahead, paged.step._make_room, []
    monkeypatch.setattr(
        paged.model,
        "look_ahead",
        lambda number, steps, upcoming, numbers: look_ahead(
            number, steps, upcoming if number % 4 else lambda _: (0, paged.cameras[0]), numbers
        ),
    )
    monkeypatch.setattr(
        paged.step,
        "_make_room",
        lambda given, failed=1: (repeated.append(given.sample.number), room_made(given, failed)),
    )
    for run in (whole, paged):
        run.take(40)
    check_same(whole.arrays(), paged.arrays())
    assert len(repeated) > 2  # the first one measures frames


@pytest.mark.slow
def test_pages_give_memory_back_for_frames(item_device, monkeypatch):
    """Under a budget that frames exceed at first, with the same bytes."""
    results = []
    for bounded in (False, True):
        if bounded:
            monkeypatch.setattr(models, "GIVEN_SHARE", 0.01)
            monkeypatch.setattr(models, "FRAME_SHARE", 0.0)  # so that they are missing at first
        run = Run(item_device, monkeypatch, 0, count=6 * COUNT)
        if bounded:
            item_device.trim()
            monkeypatch.setattr(item_device, "memory_limit", item_device.memory_bytes + 100_000)
        run.take(12)
        results.append(run.arrays())
        assert (run.model.pages is not None) == bounded
        monkeypatch.undo()
    check_same(*results)


def test_a_sum_goes_on_where_harmonics_are_paged_in_the_meantime(item_device, monkeypatch):
    whole, paged = Run(item_device, monkeypatch, 0).model, Run(item_device, monkeypatch, 3).model
    for name in ("positions", "sh_rest"):
        total = paged.add_to(name, whole.add_to(name, None))
        assert np.array_equal(total, 2 * row_of_gaussians().rows[name])
        assert np.array_equal(paged.add_to(name, total), 3 * row_of_gaussians().rows[name])


def test_harmonics_that_exceed_a_buffer_are_paged(item_device, monkeypatch):
    whole = Run(item_device, monkeypatch, 0, "coded")
    whole.take(9)
    expected = whole.arrays()
    monkeypatch.setattr(item_device, "largest_buffer", 5 * 9 * 4 * PAGE_ROWS)  # five pages
    paged = Run(item_device, monkeypatch, 0, "coded")
    paged.take(9)
    check_same(expected, paged.arrays())
    assert whole.model.pages is None and paged.model.pages.room == 5


def test_a_view_of_too_many_pages_is_refused(item_device, monkeypatch):
    run = Run(item_device, monkeypatch, 1)
    with pytest.raises(TooFewPages, match="gaussians, and there is room for the harmonics of"):
        run.take(VIEWS)
    assert run.image(3).any()  # what is only looked at comes page by page
    assert issubclass(TooFewPages, OutOfDeviceMemory)
