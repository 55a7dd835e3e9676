"""The difference between a photo and an adjacent one, through the rendered depth (SIG)."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from clsplat.covisibility.source_views import choose_source_views
from clsplat.errors import InputError
from clsplat.loss.options import ReprojectOptions
from clsplat.loss.reproject import pack_pairs, reproject
from clsplat.training.part import Decision, Inputs, Now, Part, State, Survey, TrainingSample, ViewPass
from clsplat.training.parts.exposures import PhotoResponses

if TYPE_CHECKING:
    from clsplat.schedule.plan import Plan
    from clsplat.training.session import Session
    from clsplat.training.start.prepare import PreparedScene


class Reprojection(Part):
    """Compares a view with a source view through the rendered depth, while the schedule says so."""

    name = "reprojection"
    Options = ReprojectOptions
    needs_depth = True

    @classmethod
    def decide(cls, survey: Survey) -> dict[str, Decision]:
        """On where two photos share enough points; `found` has the source views."""
        options, views = survey.options, survey.views
        if options.reproject == "off" or not options.reproject_weight:
            return {"reproject": Decision("off", "off: not requested")}
        neighbours = [adjacent.tolist() for adjacent in choose_source_views(survey.scene, views)]
        paired = sum(len(adjacent) > 0 for adjacent in neighbours)
        if paired:
            return {
                "reproject": Decision("on", f"on: {paired} of {len(views)} photos have an adjacent one", neighbours)
            }
        if options.reproject == "on":
            raise InputError(
                f"{survey.scene.name}: --reproject on needs two photos that share 20 "
                "sparse points; there are none: use --reproject auto or off"
            )
        return {"reproject": Decision("off", "off: no two photos share 20 sparse points")}

    @classmethod
    def is_used(cls, prepared: PreparedScene) -> bool:
        return prepared.decisions.parts["reproject"].found is not None

    def begin(self, session: Session) -> None:
        responses = session.part(PhotoResponses)
        self._device, self._photos, self._seed = (session.device, session.photos, session.options.seed)
        self._exposures = responses.exposures if responses else None
        self._neighbours: list[list[int]] = session.decisions.parts["reproject"].found
        self._pairs = [(view, other) for view, adjacent in enumerate(self._neighbours) for other in adjacent]
        self._first = np.cumsum([0, *map(len, self._neighbours)])  # row of a view's first pair
        # transforms from colours of the source photo to those of the reference photo, real[P, 12]
        self._colours = self._device.upload(np.tile(np.eye(3, 4).ravel(), (len(self._pairs), 1)))
        self.recentre()

    def begin_level(self, session: Session) -> None:
        cameras = [view.camera for view in session.photos.views]
        self._geometries = pack_pairs(  # real[P, 12], between pixels
            self._device, [(cameras[i], cameras[j]) for i, j in self._pairs]
        )

    def recentre(self) -> None:
        if self._exposures:  # which were recentred before
            self._colours = self._exposures.between(self._pairs)

    def _drawn(self, number: int, view: int) -> tuple[int, int] | None:
        """(row of the pair, index of a source view) of a view, or None if it has none. The view is
        random, and depends on the seed and the number of views trained on alone."""
        count = len(self._neighbours[view])
        if not count:
            return None
        rng = np.random.default_rng([self._seed, 2, number])
        row = int(self._first[view] + rng.integers(count))
        return row, self._pairs[row][1]

    def inputs(self, now: Now, sample: TrainingSample) -> Inputs | None:
        pair = self._drawn(sample.number, sample.view) if now.plan.regularises else None
        return pair and {
            "photo": self._photos[pair[1]],
            "geometries": self._geometries,
            "colours": self._colours,
            "pair": pair[0],
            "weight": float(now.plan.regularises),
        }

    def read_ahead(self, plan: Plan, view: int, number: int) -> Sequence[int]:
        pair = self._drawn(number, view) if plan.regularises else None
        return pair[1:] if pair else ()

    def add_to(self, work: ViewPass, inputs: Inputs) -> None:
        blended = work.frame.blended
        _, grad_depth, grad_transmittance = reproject(
            work.counts.device,
            blended.depth,
            blended.transmittance,
            work.photo,
            inputs["photo"],
            inputs["geometries"],
            inputs["colours"],
            inputs["pair"],
            inputs["weight"],
        )
        work.grad.add(depth=grad_depth, transmittance=grad_transmittance)

    def load(self, state: State, session: Session) -> None:
        self.recentre()  # the exposures were loaded before
