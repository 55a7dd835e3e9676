"""One training step, written as the algorithm reads."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from clsplat.constants import (
    COUNT_DONE,
    COUNT_FAILED,
    COUNT_MOST_PAIRS,
    COUNT_MOST_VISIBLE,
    COUNT_SUM_PAIRS,
    COUNT_SUM_VISIBLE,
    LACKS_PAGE,
)
from clsplat.densify.grow import Growth
from clsplat.densify.scores import Statistics
from clsplat.device import Array, Graph
from clsplat.errors import OutOfDeviceMemory
from clsplat.loss.image_loss import is_masked
from clsplat.optimise.adam import HostArrays
from clsplat.optimise.batch import BatchMean
from clsplat.optimise.rates import learning_rates
from clsplat.options import ScheduledOptions
from clsplat.rendering.pipeline import Renderer, Room
from clsplat.rendering.project import Gradients
from clsplat.schedule.plan import Plan
from clsplat.training.capacity import FrameCapacity
from clsplat.training.model import Model, Upcoming
from clsplat.training.part import Inputs, Now, Part, TrainingSample, ViewPass
from clsplat.training.units import COUNTS, Unit, Units

AHEAD = 3  # samples: when it is asked which pages of harmonics they will want
Measured = dict[str, Any]  # name of a part -> what its term of the loss measured in a view


class _Given(NamedTuple):
    """What a step is given for one view."""

    plan: Plan
    sample: TrainingSample
    numbers: Mapping[str, Any]  # what Adam needs of the step
    slot: int  # place of the view in the batch
    parts: Sequence[tuple[Part, Inputs]]  # those that take part in the view, with their inputs
    fetch: Callable[[], None]  # brings the pages that the step wants


class Step:
    """Takes training steps, which change the gaussians and what the parts learn.

    A step is enqueued without waiting for the device (units.py), from a recording of the first one
    of its kind. Whoever reads the model, the statistics or a counter gets them after all steps that
    were taken, and waits for these; whoever reads what a part has learned calls `settle` before.

    `extent` is the size of the scene, and `pixel` that of a pixel of the photos there; of the
    `parts`, one at least is a term of the loss.
    """

    def __init__(
        self,
        renderer: Renderer,
        model: Model,
        extent: float,
        pixel: float,
        options: ScheduledOptions,
        parts: Sequence[Part],
    ) -> None:
        self.renderer, self._model, self.options = renderer, model, options
        self.extent, self.pixel = extent, pixel
        self.device, self.parts = renderer.device, parts
        self._statistics = Statistics(self.device, model.count)
        self._learning = [part.skipped for part in parts if part.skipped is not None]
        self.skipped_before = self.pairs_before = 0  # of the run, before this process
        self.units, self._capacity = Units(self.device), FrameCapacity(renderer)
        self._graphs: dict[Any, Graph] = {}
        self._batch: BatchMean | None = None
        self._recorded_for: tuple[Any, ...] = 4 * (None,)
        self._failed = self.device.zeros(*COUNTS)  # of a frame that changes nothing
        self._failed.write(np.ones(1, np.uint32), COUNT_FAILED)
        self.rows_changed()

    # --- the state, after all steps

    @property
    def model(self) -> Model:
        """The gaussians."""
        self.settle()
        return self._model

    @property
    def statistics(self) -> Statistics:
        """Screen gradients since the last growth or change of level."""
        self.settle()
        return self._statistics

    @property
    def count(self) -> int:
        """The number of gaussians; does not wait."""
        return self._model.count

    @property
    def pixel_pairs(self) -> int:
        """Pairs of a gaussian and a pixel in the run; a tile counts with all its pixels."""
        return self.pairs_before + self.device.tile**2 * _long(self.settle(), COUNT_SUM_PAIRS)

    def settle(self) -> NDArray[np.uint32]:
        """Wait for all steps, and repeat those for which there was no room; returns the counts."""
        return self.units.confirm()

    def release(self) -> None:
        """Give back the memory of frames and pages, until the next step needs them again."""
        self.settle()
        self._graphs.clear()
        self.device.trim()
        if self._model.pages:
            self._model.pages.leave()

    def skipped(self) -> tuple[int, int]:
        """How many rows of gradients this process skipped, as they are not finite, and how many it
        computed: rows of gaussians (cl/project.cl) and of views (cl/exposure.cl); waits."""
        counts, counters = self.settle(), (self.renderer.skipped, *self._learning)
        by_views = int(counts[COUNT_DONE]) * len(self._learning)  # each part has one a view
        return (sum(int(counter.download()[0]) for counter in counters), _long(counts, COUNT_SUM_VISIBLE) + by_views)

    # --- a step

    def run(
        self, iteration: int, plan: Plan, samples: Iterable[TrainingSample], upcoming: Upcoming | None = None
    ) -> list[Measured]:
        """Take a step, by number from 1, on the mean loss of options.batch samples, which are read
        one at a time; returns the measurements of each, still on the device (`values`).
        `upcoming` returns the samples of this step and of later ones; None: all are as those of
        this step."""
        views, now = self.options.batch, self.now(iteration, plan)
        measured: list[Measured] = [{} for _ in range(views)]
        numbers = self._model.adam.numbers(iteration, now.rates)
        taken = range((iteration - 1) * views + 1, iteration * views + 1)
        for slot, sample in zip(range(views), samples):
            alone = _always(sample.view, sample.camera)
            parts = [(part, found) for part in self.parts if (found := part.inputs(now, sample)) is not None]
            fetch = partial(self._model.fetch, taken, plan.degree, upcoming or alone)
            given = _Given(plan, sample, numbers, slot, parts, fetch)

            def work(given: _Given = given) -> None:
                given.fetch()
                measured[given.slot] = self._take(given)
                if given.slot == views - 1:
                    self._model.adam.advance(
                        iteration, plan.degree, lambda: self._model.learned, self._model.frozen, self.units.counts
                    )

            self.units.submit(Unit(work, partial(self._make_room, given)))
            if upcoming:
                self._model.look_ahead(sample.number + AHEAD, AHEAD, upcoming, numbers)
        return measured

    def now(self, iteration: int, plan: Plan) -> Now:
        """A step, for the inputs of parts."""
        rates = learning_rates(plan.decay, self.extent, self.pixel, self.options)
        return Now(iteration, plan, (iteration - 1) / self.options.iterations, rates)

    def values(self, measured: list[Measured]) -> dict[str, float]:
        """The values of the terms of the loss, from what `run` returned; waits."""
        self.settle()
        found: dict[str, float] = {}
        for part in self.parts:
            of_views = [view[part.name] for view in measured if part.name in view]
            found |= part.values(of_views) if of_views else {}
        return found

    def _make_room(self, given: _Given, failed: int = 1) -> None:
        self._model.forget_asked()
        if failed == LACKS_PAGE:  # and no room
            return
        self._graphs.clear()  # whose memory frames with more room could not use
        self.device.trim()
        camera = self.pass_of(given.sample, given.parts).camera
        _, height, width = given.sample.photo.shape
        self._capacity.grow(self._model.rows, camera, width, height)

    def pass_of(
        self,
        sample: TrainingSample,
        parts: Sequence[tuple[Part, Inputs]] = (),
        view: int | None = None,
        counts: Array | None = None,
    ) -> ViewPass:
        """The pass of a sample, from the camera that the given parts correct; `view` and `counts`
        are inputs of a recording instead of `sample.view` and those of all units."""
        view, counts = sample.view if view is None else view, counts or self.units.counts
        work = ViewPass(view, sample.camera, sample.camera, sample.photo, self._model.rows, counts, self._model.frozen)
        for part, own in parts:
            part.camera(work, own)
        return work

    def _take(self, given: _Given) -> Measured:
        """Enqueue the work of a sample."""
        model = self._model
        state = model.memory, self._statistics.grad_norm_sum, model.frozen, self.options
        if any(new is not old for new, old in zip(state, self._recorded_for)):
            self._graphs.clear()
            self._recorded_for = state
        views = self.options.batch
        if views > 1 and not (
            self._batch and (self._batch.count, self._batch.views) == (self.count, views)
        ):  # else it may have views of this step
            self._batch = BatchMean(self.device, self._model.learned, views)
        sample, parts = given.sample, given.parts
        if not self._model.adam.RECORDS or any(part.waits for part, _ in parts):
            return self._enqueue(given, sample.view, None, self.units.counts)
        inputs: dict[str, Any] = {
            "camera": sample.camera,
            "photo": sample.photo,
            "view": sample.view,
            "counts": self.units.counts,
            **given.numbers,
        }
        for part, own in parts:
            inputs |= {f"{part.name}.{name}": value for name, value in own.items()}
        key = (
            given.slot,
            given.plan.degree,
            given.plan.gathers,
            sample.own_mask,
            tuple(part.name for part, _ in parts),
            tuple((name, value.shape) for name, value in inputs.items() if isinstance(value, Array)),
        )
        if graph := self._graphs.get(key):
            graph.replay(**inputs)
        elif not model.is_bounded:
            graph = self._graphs[key] = self._record(given, inputs)
        else:  # with a frame that has failed, so that nothing has changed if there is no memory
            failing = {**inputs, "counts": self._failed}
            graph = self._record_within(given, failing)
            if model.fill_memory():
                del graph  # it keeps the arrays of pages
                self._graphs.clear()
                given.fetch()
                graph = self._record_within(given, failing)
            self._graphs[key] = graph
            graph.replay(**inputs)
        measured: Measured = graph.result
        return measured

    def _record_within(self, given: _Given, inputs: Mapping[str, Any]) -> Graph:
        """As `_record`; where the device has no memory left, the model gives some back."""
        while True:
            try:
                return self._record(given, inputs)
            except OutOfDeviceMemory:
                self._graphs.clear()
            self._model.give_back()  # now that no exception keeps arrays alive
            given.fetch()

    def _record(self, given: _Given, inputs: Mapping[str, Any]) -> Graph:
        """Record, and enqueue, the work of a sample."""
        sample, parts = given.sample, given.parts
        _, height, width = sample.photo.shape
        with_depth = any(part.needs_depth for part, _ in parts)
        if not self._capacity.is_known(width, height, with_depth):
            self._make_room(given)
        room = self._capacity.room(self.count, width, height, with_depth)
        if not self._graphs:  # measuring left blocks of other sizes than frames need
            self.device.trim()
        with self.device.record(**inputs) as graph:
            recorded = given._replace(
                numbers={name: graph.inputs[name] for name in given.numbers},
                parts=[(part, {name: graph.inputs[f"{part.name}.{name}"] for name in own}) for part, own in parts],
            )
            graph.result = self._enqueue(recorded, graph.inputs["view"], room, graph.inputs["counts"])
        return graph

    def _enqueue(self, given: _Given, view: int, room: Room | None, counts: Array) -> Measured:
        """The work of a sample, kernel after kernel; `view` is its index, or an input."""
        plan, numbers, parts = given.plan, given.numbers, given.parts
        views, measured = self.options.batch, Measured()
        work = self.pass_of(given.sample, parts, view, counts)
        model, rows = self._model, self._model.learned
        model.require_seen(work.camera, numbers, plan.degree, counts, given.slot == views - 1)
        model.adam.catch_up_seen(rows, numbers, plan.degree, model.frozen, work.camera, counts)
        work.gradients = self._gradients(given, work, room, measured)
        del work.frame, work.grad  # so that what follows uses their memory
        for part, own in parts:
            part.learn(work, own)
        gradients = work.gradients
        if self._batch:
            self._batch.add(gradients, plan.degree)
            if given.slot < views - 1:
                return measured
            gradients = self._batch.mean(counts, plan.degree, self.count if room else None)
        model.adam.apply(rows, gradients, numbers, plan.degree, model.frozen)
        for part, own in parts:
            part.move(work, own)
        return measured

    def _gradients(self, given: _Given, work: ViewPass, room: Room | None, measured: Measured) -> Gradients:
        """The gradients of one sample; adds to `measured` and to the statistics."""
        parts, photo, plan = given.parts, work.photo, given.plan
        for part, own in parts:
            part.respond(work, own)
        work.frame = self.renderer.render(
            work.rows,
            work.camera,
            photo.shape[2],
            photo.shape[1],
            plan.degree,
            any(part.needs_depth for part, _ in parts),
            room,
            work.counts,
            work.exposure,
        )
        for part, own in parts:
            if (result := part.add_to(work, own)) is not None:
                measured[part.name] = result
        for part, own in parts:
            part.adjoint(work, own)
        grad = work.grad
        assert grad.image is not None  # a term of the loss compares the image
        return self.renderer.adjoint(
            work.rows,
            work.frame,
            grad.image,
            grad.depth,
            grad.transmittance,
            self._model.frozen,
            self._statistics.sums if plan.gathers else None,
            photo if is_masked(photo) and given.sample.own_mask else None,
            any(part.needs_pose for part, _ in parts),
        )

    # --- other levels and other rows

    def begin_level(self) -> None:
        """Begin a level, or another size of photos: no statistics, and other room."""
        self.statistics.clear(self.count)
        self.choose_room(False)

    def choose_room(self, is_alike: bool) -> None:
        """Choose room anew, for frames that are or are not like those so far.

        After growth they are: the margin of the room is more than what a round usually adds.
        """
        counts, most = self.settle(), [COUNT_MOST_VISIBLE, COUNT_MOST_PAIRS]
        self._capacity.reset(*(counts[most].tolist() if is_alike else ()))
        counts[most] = 0
        self.units.counts.write(counts)
        self.units.poll_soon()
        self._graphs.clear()
        self.device.trim()  # frames will need blocks of other sizes

    def replace_rows(self, growth: Growth) -> None:
        """Replace the gaussians as a round of growth requires."""
        self.release()  # or recordings would keep the memory of frames while rows are copied
        self._model.regrow(growth)
        self.rows_changed(growth)
        self._statistics.clear(self._model.count)

    def replace_others(self, kept: NDArray[np.integer], rows: HostArrays, m: HostArrays, v: HostArrays) -> None:
        """Replace all gaussians but those at `kept`, int[K], which come first then and keep their
        moments, by others: their rows and their moments, by field."""
        self.release()
        self._model.catch_up()
        if self._model.pages:
            self._model.pages.leave()
        source = np.concatenate([kept, np.zeros(len(rows["positions"]))]).astype(np.uint32)
        self.replace_rows(
            Growth(source, len(kept), 0, 0, 0, {name: (len(kept), values) for name, values in rows.items()})
        )
        self._model.adam.write(m, v, len(kept))
        self.choose_room(True)

    def rows_changed(self, growth: Growth | None = None) -> None:
        """Let the parts follow a change of the rows; see `Part.rows_changed`."""
        for part in self.parts:
            part.rows_changed(self._model, growth)


def _always(view: int, camera: Array) -> Upcoming:
    """All samples are of this view."""
    return lambda number: (view, camera)


def _long(counts: NDArray[np.uint32], place: int) -> int:
    """A sum of 64 bits in two words of the counts."""
    return int(counts[place]) | int(counts[place + 1]) << 32
