"""A response of each photo, learned beside the gaussians: exposure and vignetting."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np

from clsplat.config.option import AUTO
from clsplat.covisibility.photometry import DARKENS, DRIFTS, corner_darkening, exposure_drift
from clsplat.errors import InputError
from clsplat.io.runs.run import write_exposures
from clsplat.loss.exposure import Exposures
from clsplat.loss.options import ExposureOptions
from clsplat.response import Lenses, Response
from clsplat.training.part import Decision, Inputs, Part, State, Survey, ViewPass, requested

if TYPE_CHECKING:
    from clsplat.io.runs.run import RunFolder
    from clsplat.training.session import Session
    from clsplat.training.start.prepare import PreparedScene

SAMPLED_PHOTOS = 64  # whose brightness is compared


class PhotoResponses(Part):
    """Applies the response of its photo to each image before the loss, and learns it.

    Learning begins at the `known` responses, by the names of views, and else at the identity.
    """

    name = "exposure"
    Options = ExposureOptions
    exposures: Exposures

    def __init__(self, known: Mapping[str, Response] | None = None, learns: bool = True) -> None:
        self._known, self._learns = known, learns

    @classmethod
    def decide(cls, survey: Survey) -> dict[str, Decision]:
        """On if the brightness of photos drifts; vignetting only with exposures."""
        exposure = _exposure(survey)
        return {"exposure": exposure, "vignetting": _vignetting(survey, exposure)}

    @classmethod
    def is_used(cls, prepared: PreparedScene) -> bool:
        return prepared.options.exposure == "on"

    def begin(self, session: Session) -> None:
        options, views = session.options, session.train_views
        known = self._known and [self._known.get(view.name, Response()) for view in views]
        lenses = (
            None
            if options.vignetting != "on"
            else (Lenses.of_responses(known) if known else Lenses.of_cameras([view.camera for view in views]))
        )
        self.exposures = Exposures(
            session.device,
            len(views),
            learns=self._learns,
            lenses=lenses,
            initial=np.array([response.transform for response in known]) if known else None,
        )
        self.skipped = self.exposures.skipped

    def recentre(self) -> None:
        self.exposures.recentre()

    def respond(self, work: ViewPass, inputs: Inputs) -> None:
        work.exposure = self.exposures.of(work.view, work.camera)

    def adjoint(self, work: ViewPass, inputs: Inputs) -> None:
        """Also take one step of Adam on the response."""
        assert work.grad.image is not None  # the image term is always used
        work.grad.image, partials = self.exposures.adjoint(work.view, work.camera, work.frame.image, work.grad.image)
        self.exposures.step(work.view, partials, work.counts)

    def responses(self, session: Session) -> dict[str, Response]:
        """The learned responses of the training views by name."""
        return {view.name: response for view, response in zip(session.train_views, self.exposures.responses())}

    def state(self) -> State:
        return self.exposures.download()

    def load(self, state: State, session: Session) -> None:
        self.exposures.upload(dict(state))

    def write(self, run: RunFolder, session: Session) -> None:
        """Write exposures.json."""
        write_exposures(run.path, self.responses(session))


def _exposure(survey: Survey) -> Decision:
    if survey.options.exposure != AUTO:
        return requested(survey.options.exposure)
    small, photos = survey.thumbnails.sampled(SAMPLED_PHOTOS)
    drift = exposure_drift(small, photos, survey.scene.points, survey.scene.colours)
    value = "on" if drift >= DRIFTS else "off"
    return Decision(
        value,
        f"{value}: the brightness of {len(small)} photos varies by "
        f"{100 * drift:.1f} % ({100 * DRIFTS:.1f} % counts as drift)",
    )


def _vignetting(survey: Survey, exposure: Decision) -> Decision:
    """On only with exposures, with which it is learned."""
    asked = survey.options.vignetting
    if exposure.value == "off":
        if asked == "on":
            raise InputError("--vignetting on: is learned with exposures only; add --exposure on")
        return Decision("off", "off: exposures are not learned")
    if asked != AUTO:
        return requested(asked) if asked == "on" else Decision("off", "off: not requested")
    small, photos = survey.thumbnails.sampled(SAMPLED_PHOTOS)
    darker = corner_darkening(small, photos, survey.scene.points)
    value = "on" if darker >= DARKENS else "off"
    return Decision(
        value,
        f"{value}: the corners of {len(small)} photos are {100 * darker:.1f} % "
        f"darker than their middle ({100 * DARKENS:.1f} % counts as vignetting)",
    )
