"""What a block's photos show of its surroundings, drawn behind and in front of it."""

from __future__ import annotations

from typing import TYPE_CHECKING

from clsplat.loss.exposure import Exposures
from clsplat.schedule.plan import size_at
from clsplat.training.layers import Layers
from clsplat.training.part import Inputs, Now, Part, TrainingSample, ViewPass

if TYPE_CHECKING:
    from clsplat.training.session import Session
    from clsplat.training.start.prepare import PreparedScene


class Backdrop(Part):
    """Puts layers of the surroundings behind and in front of the image before the loss.

    Parameters
    ----------
    layers : the layers of the views; None: a session draws those of its block.
    """

    name = "backdrop"

    def __init__(self, layers: Layers | None = None) -> None:
        self.layers = layers

    @classmethod
    def is_used(cls, prepared: PreparedScene) -> bool:
        """Whether the block has surroundings."""
        return prepared.surroundings is not None

    def begin(self, session: Session) -> None:
        """Draw the first level, before there is a model, as that needs memory."""
        prepared = session.prepared
        if self.layers is None:
            assert prepared.surroundings is not None
            self.layers = Layers(session.device, prepared.scene, prepared.surroundings,
                                 prepared.near, prepared.options)
        # the layers are put in front where the image is exposed
        self._plain = Exposures(session.device, len(session.train_views), learns=False)
        self.begin_level(session)

    def begin_level(self, session: Session) -> None:
        """Draw the layers of the photos' level."""
        assert self.layers is not None
        photos = session.photos
        session.progress.phase(f"drawing what surrounds the block at {size_at(photos.level)}")
        self.layers.use(photos.level, photos.views, photos.spare_bytes)
        self.resident = self.layers.resident

    def inputs(self, now: Now, sample: TrainingSample) -> Inputs:
        """The layers of the view."""
        assert self.layers is not None
        return {"layers": self.layers[sample.view]}

    def respond(self, work: ViewPass, inputs: Inputs) -> None:
        """Set the layers."""
        work.backdrop = inputs["layers"]
        self._exposes = work.exposure is None
        if work.exposure is None:
            work.exposure = self._plain.of(work.view, work.camera)

    def adjoint(self, work: ViewPass, inputs: Inputs) -> None:
        """As `Part.adjoint`, unless the photo's response has done it."""
        if self._exposes:
            assert work.grad.image is not None  # the image term is always used
            work.grad.image, _ = self._plain.adjoint(
                work.view, work.camera, work.frame.image, work.grad.image, work.backdrop)
