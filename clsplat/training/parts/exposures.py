"""A response of each photo, learned beside the gaussians: exposure and vignetting."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING

import numpy as np

from clsplat.config.option import AUTO
from clsplat.covisibility.exposure_drift import DRIFTS, exposure_drift
from clsplat.covisibility.vignetting import DARKENS, corner_darkening
from clsplat.errors import InputError
from clsplat.loss.exposure import Exposures
from clsplat.loss.options import ExposureOptions
from clsplat.response import Lenses, Response
from clsplat.training.part import Decision, Inputs, Part, State, Survey, ViewPass, requested

if TYPE_CHECKING:
    from clsplat.io.runs.run import RunFolder
    from clsplat.scene import Scene, View
    from clsplat.training.session import Session
    from clsplat.training.start.prepare import PreparedScene

SAMPLED_PHOTOS = 64  # whose brightness is compared


class PhotoResponses(Part):
    """Applies the response of its photo to each image before the loss, and learns it.

    Attributes
    ----------
    exposures : the responses, and their Adam.
    """

    name = "exposure"
    Options = ExposureOptions
    exposures: Exposures

    @classmethod
    def decide(cls, survey: Survey) -> dict[str, Decision]:
        """On if the brightness of photos drifts; vignetting only with exposures."""
        exposure = _exposure(survey)
        return {"exposure": exposure, "vignetting": _vignetting(survey, exposure)}

    @classmethod
    def is_used(cls, prepared: PreparedScene) -> bool:
        """Whether responses are learned, or were by the coarse run."""
        return prepared.options.exposure == "on"

    def begin(self, session: Session) -> None:
        """As `Part.begin`; a block goes on with the responses of the coarse run."""
        scene, options, views = session.scene, session.options, session.train_views
        initial = initial_responses(scene, session.train_views)
        self.exposures = Exposures(
            # blocks that learned their own would not agree
            session.device, len(views), learns=initial is None or scene.region is None,
            initial=None if initial is None else np.array([
                response.transform for response in initial]),
            lenses=lenses_of(scene, views, options))
        self.skipped = self.exposures.skipped

    def recentre(self) -> None:
        """Restore the initial mean of the responses."""
        self.exposures.recentre()

    def respond(self, work: ViewPass, inputs: Inputs) -> None:
        """Set the response of the photo."""
        work.exposure = self.exposures.of(work.view, work.camera)

    def adjoint(self, work: ViewPass, inputs: Inputs) -> None:
        """As `Part.adjoint`, with one step of Adam on the response."""
        assert work.grad.image is not None  # the image term is always used
        work.grad.image, partials = self.exposures.adjoint(
            work.view, work.camera, work.frame.image, work.grad.image, work.backdrop)
        self.exposures.step(work.view, partials, work.counts)

    def responses(self, session: Session) -> dict[str, Response]:
        """The learned responses of the training views by name."""
        return {view.name: response for view, response in zip(
            session.train_views, self.exposures.responses())}

    def state(self) -> State:
        """As `Part.state`."""
        return self.exposures.download()

    def load(self, state: State, session: Session) -> None:
        """As `Part.load`."""
        self.exposures.upload(dict(state))

    def write(self, run: RunFolder, session: Session) -> None:
        """Write exposures.json."""
        run.save_exposures(self.responses(session))


def initial_responses(scene: Scene, views: Iterable[View]) -> list[Response] | None:
    """The responses of a block's views, from the coarse run; None without them.

    A view that has none gets the identity.
    """
    if not scene.exposures:
        return None
    return [scene.exposures.get(view.name, Response()) for view in views]


def lenses_of(scene: Scene, views: Sequence[View], options: ExposureOptions) -> Lenses | None:
    """The lenses of the training views; None if nothing is learned of them."""
    if options.vignetting != "on":
        return None
    known = initial_responses(scene, views)
    return (Lenses.of_responses(known) if known else
            Lenses.of_cameras([view.camera for view in views]))


def _exposure(survey: Survey) -> Decision:
    if survey.options.exposure != AUTO:
        return requested(survey.options.exposure)
    small, photos = survey.thumbnails.sampled(SAMPLED_PHOTOS)
    drift = exposure_drift(small, photos, survey.scene.points, survey.scene.colours)
    value = "on" if drift >= DRIFTS else "off"
    return Decision(value, f"{value}: the brightness of {len(small)} photos varies by "
                    f"{100 * drift:.1f} % ({100 * DRIFTS:.1f} % counts as drift)")


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
    return Decision(value, f"{value}: the corners of {len(small)} photos are {100 * darker:.1f} % "
                    f"darker than their middle ({100 * DARKENS:.1f} % counts as vignetting)")
