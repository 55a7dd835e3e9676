"""The difference between a photo and an adjacent one, through the rendered depth (SIG)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from clsplat.camera import Camera
from clsplat.covisibility.source_views import choose_source_views
from clsplat.device import Device
from clsplat.errors import InputError
from clsplat.loss.exposure import Exposures
from clsplat.loss.options import ReprojectOptions
from clsplat.loss.reproject import pack_pairs, reproject
from clsplat.training.part import (
    Decision,
    Inputs,
    Now,
    Part,
    State,
    Survey,
    TrainingSample,
    ViewPass,
)
from clsplat.training.parts.exposures import PhotoResponses

if TYPE_CHECKING:
    from clsplat.schedule import Plan
    from clsplat.training.photos import Photos
    from clsplat.training.session import Session
    from clsplat.training.start.prepare import PreparedScene


class SourceViews:
    """Pairs of a reference and a source view, with the transforms between them on the device.

    Parameters
    ----------
    neighbours : indices of the source views of each view (covisibility/source_views.py).
    exposures : colour transforms of the views, or None.
    seed : of the random choice of source views.

    Attributes
    ----------
    pairs : [(reference view, source view), ...].
    geometries : real[P, 12]; between pixels, at the present level (`loss.reproject.pack_pairs`).
    colours : real[P, 12]; from colours of the source photo to those of the reference photo.
    """

    def __init__(self, device: Device, neighbours: Sequence[Sequence[int]],
                 exposures: Exposures | None, seed: int) -> None:
        self.device, self.exposures, self.seed = device, exposures, seed
        self.neighbours = neighbours
        self.pairs = [(view, int(other)) for view, adjacent in enumerate(neighbours)
                      for other in adjacent]
        self._first = np.cumsum([0, *map(len, neighbours)])  # row of a view's first pair
        self.compare_colours()

    def use(self, cameras: Sequence[Camera]) -> None:
        """Use the views' cameras at a level from now on."""
        self.geometries = pack_pairs(self.device, [(cameras[i], cameras[j]) for i, j in self.pairs])

    def compare_colours(self) -> None:
        """Update `colours`; called only after exposures are recentred, because it waits."""
        unchanged = np.tile(np.eye(3, 4).ravel(), (len(self.pairs), 1))
        self.colours = (self.exposures.between(self.pairs) if self.exposures
                        else self.device.upload(unchanged))

    def drawn(self, number: int, view: int) -> tuple[int, int] | None:
        """(row of the pair, index of a source view) of a view, or None if it has none. The view is
        random, and depends on the seed and the number of views trained on alone."""
        count = len(self.neighbours[view])
        if not count:
            return None
        row = int(self._first[view] + np.random.default_rng([self.seed, 2, number]).integers(count))
        return row, self.pairs[row][1]


class Reprojection(Part):
    """Compares a view with a source view through the rendered depth, while the schedule says so."""

    name = "reprojection"
    Options = ReprojectOptions
    needs_depth = True
    sources: SourceViews

    @classmethod
    def decide(cls, survey: Survey) -> dict[str, Decision]:
        """On where two photos share enough points; `found` has the source views."""
        options, views = survey.options, survey.views
        if options.reproject == "off" or not options.reproject_weight:
            return {"reproject": Decision("off", "off: not requested")}
        neighbours = [adjacent.tolist() for adjacent in choose_source_views(survey.scene, views)]
        paired = sum(len(adjacent) > 0 for adjacent in neighbours)
        if paired:
            return {"reproject": Decision(
                "on", f"on: {paired} of {len(views)} photos have an adjacent one",
                options.reproject == "on", neighbours)}
        if options.reproject == "on":
            raise InputError(f"{survey.scene.name}: --reproject on needs two photos that share 20 "
                             "sparse points; there are none: use --reproject auto or off")
        return {"reproject": Decision("off", "off: no two photos share 20 sparse points")}

    @classmethod
    def is_used(cls, prepared: PreparedScene) -> bool:
        return prepared.decisions.parts["reproject"].found is not None

    def begin(self, session: Session) -> None:
        responses = session.part(PhotoResponses)
        self._photos: Photos = session.photos
        self.sources = SourceViews(
            session.device, session.decisions.parts["reproject"].found,
            responses.exposures if responses else None, session.options.seed)

    def begin_level(self, session: Session) -> None:
        self.sources.use([view.camera for view in session.photos.views])

    def recentre(self) -> None:
        """Follow the exposures, which were recentred before."""
        if self.sources.exposures:
            self.sources.compare_colours()

    def inputs(self, now: Now, sample: TrainingSample) -> Inputs | None:
        """A source view, the transforms to it and the weight; None without a weight or a view."""
        pair = self.sources.drawn(sample.number, sample.view) if now.plan.regularises else None
        return pair and {"photo": self._photos[pair[1]], "geometries": self.sources.geometries,
                         "colours": self.sources.colours, "pair": pair[0],
                         "weight": float(now.plan.regularises)}

    def read_ahead(self, plan: Plan, view: int, number: int) -> Sequence[int]:
        pair = self.sources.drawn(number, view) if plan.regularises else None
        return pair[1:] if pair else ()

    def add_to(self, work: ViewPass, inputs: Inputs) -> None:
        blended = work.frame.blended
        _, grad_depth, grad_transmittance = reproject(
            work.counts.device, blended.depth, blended.transmittance, work.photo, inputs["photo"],
            inputs["geometries"], inputs["colours"], inputs["pair"], inputs["weight"])
        work.grad.add(depth=grad_depth, transmittance=grad_transmittance)

    def load(self, state: State, session: Session) -> None:
        """Follow the exposures, which were loaded before."""
        self.recentre()
