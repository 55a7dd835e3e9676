"""One training step, written as the algorithm reads, and the growth that may follow it."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.constants import (
    COUNT_DONE,
    COUNT_MOST_PAIRS,
    COUNT_MOST_VISIBLE,
    COUNT_SUM_PAIRS,
    COUNT_SUM_VISIBLE,
)
from clsplat.densify.statistics import Statistics
from clsplat.device import Array, Graph
from clsplat.gaussians import LEARNED
from clsplat.loss.exposure import Exposures
from clsplat.loss.image_loss import is_masked
from clsplat.loss.regularise import regularise
from clsplat.loss.term import FrameGradient, LossTerm, TrainingSample
from clsplat.loss.terms import terms_of
from clsplat.optimise.batch import BatchMean
from clsplat.optimise.noise import add_noise
from clsplat.optimise.pose import Poses, pose_rate
from clsplat.optimise.rates import learning_rates
from clsplat.options import TrainOptions
from clsplat.rendering.pipeline import Gradients, Renderer, Room
from clsplat.schedule import Plan, Schedule
from clsplat.training.growth import Round, ScoringViews
from clsplat.training.model import Model
from clsplat.training.rooms import Rooms
from clsplat.training.skipped_gradients import SkippedGradients
from clsplat.training.units import Unit, Units

RESET_OPACITY = 0.01
Measured = dict[str, Any]  # name of a loss term -> its measurements in a view


class Step:
    """Takes training steps, which change the gaussians and exposures.

    A step is enqueued without waiting for the device (units.py), from a recording of the first one
    of its kind. Whoever reads the model, the exposures, the statistics or a counter gets them after
    all steps that were taken, and waits for these.

    Parameters
    ----------
    renderer : of the training.
    model : the gaussians.
    extent : world units; size of the scene.
    options : with scaled steps.
    exposures : colour transforms of the views; None: views have none.
    poses : corrections of the poses of the views; None: they stay as they were given.
    trains : (positions, log_scales) float32[N, 3] -> bool[N], those that are trained; called
        at each round of growth; None: all are.

    Attributes
    ----------
    terms : terms of the loss (clsplat/loss/terms.py).
    skipped : counts gradients that were not finite.
    units : the steps that are not known to be done.
    """

    def __init__(self, renderer: Renderer, model: Model, extent: float, options: TrainOptions,
                 exposures: Exposures | None = None, poses: Poses | None = None,
                 trains: Callable[..., NDArray[np.bool_]] | None = None) -> None:
        self.renderer, self._model, self.extent, self.options = renderer, model, extent, options
        self.device, self._exposures, self.trains = renderer.device, exposures, trains
        self._poses = poses
        self.terms = terms_of(self.device, options)
        self._statistics = Statistics(self.device, model.count)
        self.skipped = SkippedGradients(
            renderer.skipped, *(learned.skipped for learned in (exposures, poses) if learned))
        self.units, self._rooms = Units(self.device), Rooms(renderer)
        self._graphs: dict[Any, Graph] = {}
        self._batch: BatchMean | None = None
        self._recorded_for: tuple[Any, ...] = 4 * (None,)
        self.freeze()
        self._earlier_pairs = 0  # of the run, before this process

    # --- the state, after all steps

    @property
    def model(self) -> Model:
        """The gaussians."""
        self.settle()
        return self._model

    @property
    def frozen(self) -> Array | None:
        """uint[N] on the device; not 0 for gaussians that are not trained; None: all are."""
        return self._model.frozen

    @property
    def exposures(self) -> Exposures | None:
        """The colour transforms of the views; None: views have none."""
        self.settle()
        return self._exposures

    @property
    def poses(self) -> Poses | None:
        """The corrections of the poses of the views; None: they stay as they were given."""
        self.settle()
        return self._poses

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
        return self._earlier_pairs + self.device.tile**2 * _long(self.settle(), COUNT_SUM_PAIRS)

    @pixel_pairs.setter
    def pixel_pairs(self, number: int) -> None:
        """Go on from those of a resumed run."""
        self._earlier_pairs += number - self.pixel_pairs

    def settle(self) -> NDArray[np.uint32]:
        """Wait for all steps, and repeat those for which there was no room; returns the counts."""
        return self.units.confirm()

    def release(self) -> None:
        """Give back the memory of frames, until the next step records them again."""
        self.settle()
        self._graphs.clear()
        self.device.trim()

    def poll_skipped(self) -> bool:
        """Update `skipped`, and tell whether the first gradients were skipped; waits."""
        counts = self.settle()
        # each view has one by its transform, and one by its pose
        by_views = int(counts[COUNT_DONE]) * (bool(self._exposures) + bool(self._poses))
        return self.skipped.poll(_long(counts, COUNT_SUM_VISIBLE) + by_views)

    # --- a step

    def run(self, iteration: int, plan: Plan, samples: Iterable[TrainingSample]) -> list[Measured]:
        """Take a step on the mean loss of options.batch samples.

        Parameters
        ----------
        iteration : number of the step, from 1.
        plan : the schedule's decisions for it.
        samples : training views; read one at a time.

        Returns
        -------
        The measurements of each sample, still on the device; see `values`.
        """
        views = self.options.batch
        measured: list[Measured] = [{} for _ in range(views)]
        rates = learning_rates(plan.decay, self.extent, self.options.opacity_rate)
        numbers = {**self._model.adam.numbers(iteration, rates),
                   "noise": self.options.position_noise * rates["positions"],
                   "pose_rate": pose_rate((iteration - 1) / self.options.iterations)}
        for slot, sample in zip(range(views), samples):
            def work(slot: int = slot, sample: TrainingSample = sample) -> None:
                measured[slot] = self._take(plan, sample, numbers, slot)
                if slot == views - 1:
                    self._model.adam.advance(iteration, plan.degree, self._learned,
                                             self.frozen, self.units.counts)
            self.units.submit(Unit(work, partial(self._make_room, sample)))
        return measured

    def values(self, measured: list[Measured]) -> dict[str, float]:
        """The values of the loss terms, from what `run` returned; waits."""
        self.settle()
        return {name: value for term in self.terms for name, value in term.values(
            [view[term.name] for view in measured if term.name in view]).items()}

    def terms_in(self, plan: Plan) -> list[LossTerm]:
        """The terms of the loss that a plan uses."""
        return [term for term in self.terms if term.weight(plan)]

    def _terms_for(self, plan: Plan, sample: TrainingSample) -> list[LossTerm]:
        """Those that can be computed for a sample."""
        return [term for term in self.terms_in(plan)
                if (sample.source or not term.needs_source)
                and (sample.depth is not None or not term.needs_map)]

    def _make_room(self, sample: TrainingSample) -> None:
        _, height, width = sample.photo.shape
        self._graphs.clear()  # whose memory frames with more room could not use
        self.device.trim()
        self._rooms.enlarge(self._model.rows, self._camera_of(sample), width, height)

    def _take(self, plan: Plan, sample: TrainingSample, numbers: Mapping[str, float], slot: int
              ) -> Measured:
        """Enqueue the work of a sample, the slot-th of its step."""
        state = (self._model.layout, self._statistics.grad_norm_sum, self.frozen, self.options)
        if any(new is not old for new, old in zip(state, self._recorded_for)):
            self._graphs.clear()
            self._recorded_for = state
            if self.options.batch > 1:
                self._batch = BatchMean(self.device, self._learned(), self.options.batch)
        source, terms = sample.source, self._terms_for(plan, sample)
        numbers = {**numbers, **{_weight(term): float(term.weight(plan)) for term in terms}}
        if not self._model.adam.RECORDS or any(term.waits for term in terms):
            return self._enqueue(plan, sample, numbers, slot, None)
        inputs: dict[str, Any] = {"camera": sample.camera, "photo": sample.photo,
                                  "view": sample.view, **numbers}
        if source:
            inputs |= {"source": source.photo, "geometries": source.geometries,
                       "colours": source.colours, "pair": source.pair}
        if any(term.needs_map for term in terms):
            inputs["depth_map"] = sample.depth
        if sample.layers is not None:
            inputs["layers"] = sample.layers
        key = (slot, plan.degree, plan.gathers, tuple(term.name for term in terms),
               sample.photo.shape, sample.own_mask, source and source.photo.shape,
               None if sample.layers is None else sample.layers.shape)
        if graph := self._graphs.get(key):
            graph.replay(**inputs)
        else:
            with_depth = any(term.needs_depth for term in terms)
            _, height, width = sample.photo.shape
            if not self._rooms.knows(width, height, with_depth):
                self._make_room(sample)
            room = self._rooms.room(self.count, width, height, with_depth)
            if not self._graphs:  # measuring left blocks of other sizes than frames need
                self.device.trim()
            with self.device.record(**inputs) as graph:
                graph.result = self._enqueue(plan, _of_inputs(graph.inputs, sample), graph.inputs,
                                             slot, room)
            self._graphs[key] = graph
        measured: Measured = graph.result
        return measured

    def _enqueue(self, plan: Plan, sample: TrainingSample, numbers: Mapping[str, Any], slot: int,
                 room: Room | None) -> Measured:
        """The work of a sample, kernel after kernel."""
        views, used = self.options.batch, self._used(plan.degree)
        measured: Measured = {}
        given, sample = sample.camera, replace(sample, camera=self._camera_of(sample))
        self._model.adam.catch_up_seen(self._learned(), numbers, plan.degree, self.frozen,
                                       sample.camera, self.units.counts)
        gradients = self._gradients_of(plan, sample, measured, numbers, room)
        if self._poses:
            assert gradients.pose_terms is not None
            self._poses.step(sample.view, numbers["pose_rate"], given, gradients.pose_terms,
                             self.units.counts)
        if self._batch:
            self._batch.add(gradients, used)
            if slot < views - 1:
                return measured
            gradients = self._batch.mean(self.units.counts, used,
                                         self.count if room else None)
        self._model.adam.apply(self._learned(), gradients, numbers, used, self.frozen)
        if self.options.position_noise:
            add_noise(self._model.rows, numbers["noise"], numbers["now"], self.options.seed,
                      self.units.counts, self.frozen)
        return measured

    def _gradients_of(self, plan: Plan, sample: TrainingSample, measured: Measured,
                      numbers: Mapping[str, Any], room: Room | None) -> Gradients:
        """The gradients of one sample; adds to `measured` and to the statistics."""
        rows, exposures, counts = self._model.rows, self._exposures, self.units.counts
        _, height, width = sample.photo.shape
        terms = self._terms_for(plan, sample)
        exposure = exposures.of(sample.view, sample.camera) if exposures else None
        frame = self.renderer.render(rows, sample.camera, width, height, plan.degree,
                                     any(term.needs_depth for term in terms), room, counts,
                                     exposure, sample.layers)
        grad = FrameGradient()
        for term in terms:
            measured[term.name] = term.add_to(grad, frame, frame.exposed, sample,
                                              numbers[_weight(term)])
        assert grad.image is not None  # the image loss is always used
        if exposures:
            grad.image, partials = exposures.adjoint(sample.view, sample.camera, frame.image,
                                                     grad.image, sample.layers)
            exposures.step(sample.view, partials, counts)
        gradients = self.renderer.adjoint(
            rows, frame, grad.image, grad.depth, grad.transmittance, self.frozen,
            self._statistics.sums if plan.gathers else None,
            sample.photo if is_masked(sample.photo) and sample.own_mask else None,
            bool(self._poses))
        if self.options.opacity_weight or self.options.scale_weight:
            regularise(rows, gradients, self.options.opacity_weight, self.options.scale_weight)
        return gradients

    def _camera_of(self, sample: TrainingSample) -> Array:
        """The packed camera of a sample, with the corrected pose."""
        if self._poses is None:
            return sample.camera
        return self._poses.apply(sample.view, sample.camera)

    def _learned(self) -> dict[str, Array]:
        rows = self._model.rows
        return {field.name: rows[field.name] for field in LEARNED}

    def _used(self, degree: int) -> dict[str, int]:
        """Field -> floats of a row that are trained: without inactive spherical harmonics."""
        used = {field.name: field.width(self._model.sh_degree) for field in LEARNED}
        return {**used, "sh_rest": 3 * degree * (degree + 2)}

    # --- growth

    def densify(self, iteration: int, plan: Plan, schedule: Schedule,
                scoring_views: ScoringViews) -> dict[str, int] | None:
        """Do the round of growth and the opacity reset that follow a step.

        Parameters
        ----------
        iteration : number of the step, from 1.
        plan : of that step.
        schedule : decides how many gaussians are added, and how they are selected.
        scoring_views : returns some training views, for a schedule that scores gaussians.

        Returns
        -------
        How many gaussians were cloned, split and pruned; None without growth.
        """
        event = self._grow(iteration, plan, schedule, scoring_views) if plan.grows else None
        if plan.resets_opacity:
            self.model.limit_opacity(np.log(RESET_OPACITY / (1 - RESET_OPACITY)),
                                     None if self.frozen is None else self.frozen.download() == 0)
        return event

    def begin_level(self) -> None:
        """Begin a level, or another size of photos: no statistics, and other room."""
        self.statistics.clear(self.count)
        self._choose_room(False)

    def _choose_room(self, is_alike: bool) -> None:
        """Choose room anew, for frames that are or are not like those so far.

        After growth they are: the margin of the room is more than what a round usually adds.
        """
        counts, most = self.settle(), [COUNT_MOST_VISIBLE, COUNT_MOST_PAIRS]
        self._rooms.forget(*(counts[most].tolist() if is_alike else ()))
        counts[most] = 0
        self.units.counts.write(counts)
        self.units.hurry()
        self._graphs.clear()
        self.device.trim()  # frames will need blocks of other sizes

    def freeze(self, known: NDArray[np.bool_] | None = None) -> None:
        """Determine which gaussians are frozen.

        Parameters
        ----------
        known : bool[K], whether the first K gaussians are; None: that of none is known.
        """
        if self.trains:
            known = np.zeros(0, bool) if known is None else known
            rows = (self.model.rows[name].download()[len(known):]
                    for name in ("positions", "log_scales"))
            self._model.frozen = self.device.upload(
                np.concatenate([known, ~self.trains(*rows)]).astype(np.uint32))

    def _grow(self, iteration: int, plan: Plan, schedule: Schedule,
              scoring_views: ScoringViews) -> dict[str, int]:
        model, statistics = self.model, self.statistics
        model.catch_up()
        self.freeze()
        frozen = np.zeros(model.count, bool) if self.frozen is None else self.frozen.download() > 0
        growth = Round(iteration, plan, schedule, self.options, self.extent,
                       statistics.mean_gradient, frozen).growth(
                           self.renderer, model.rows, scoring_views)
        self.release()  # or recordings would keep the memory of frames while rows are copied
        model.regrow(growth)
        self.freeze(frozen[growth.source[:growth.unchanged]])
        statistics.clear(model.count)
        self._choose_room(True)
        return {"cloned": growth.cloned, "split": growth.split, "pruned": growth.pruned}


def _weight(term: LossTerm) -> str:
    """The name of a term's weight among the numbers of a step."""
    return f"weight_{term.name}"


def _long(counts: NDArray[np.uint32], place: int) -> int:
    """A sum of 64 bits in two words of the counts."""
    return int(counts[place]) | int(counts[place + 1]) << 32


def _of_inputs(inputs: Mapping[str, Any], sample: TrainingSample) -> TrainingSample:
    """A sample whose numbers are the inputs of a recording."""
    source = sample.source and sample.source._replace(pair=inputs["pair"])
    return replace(sample, view=inputs["view"], source=source)
