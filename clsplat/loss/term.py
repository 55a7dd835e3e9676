"""What a term of the training loss is, and what a step gives it.

A new term is one file with a subclass of `LossTerm`, and one line in `terms.TERMS`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

from clsplat.device import Array, Device
from clsplat.primitives.reduce import add_to
from clsplat.rendering.frame_arrays import FrameArray
from clsplat.rendering.pipeline import Frame
from clsplat.schedule import Plan

if TYPE_CHECKING:
    from clsplat.options import TrainOptions


class SourceView(NamedTuple):
    """A second view of what a reference view shows.

    Attributes
    ----------
    photo : uchar[3, H, W], the source view's photo.
    geometries : real[P, 12], of all pairs of views (`reproject.pack_pairs`).
    colours : real[P, 12], that take display values of a source photo to the reference photo's.
    pair : the row of this pair in both.
    """

    photo: Array
    geometries: Array
    colours: Array
    pair: int


@dataclass(frozen=True, eq=False)
class TrainingSample:
    """What a step learns from one view.

    Attributes
    ----------
    view : index of the training view.
    camera : real[27], packed.
    photo : uchar[3, H, W].
    source : a source view, where a term of this step compares with one.
    """

    view: int
    camera: Array
    photo: Array
    source: SourceView | None = None


@dataclass(eq=False)
class FrameGradient:
    """Gradient of a loss by what a frame shows; None where it is zero.

    Attributes
    ----------
    image : real[3, H, W], by the image after the view's colour transform.
    depth : real[H, W], by the depth channel.
    transmittance : real[H, W].
    """

    image: Array | None = None
    depth: Array | None = None
    transmittance: Array | None = None

    def add(self, **gradients: Array) -> None:
        """Add gradients, by the names above; they are this object's from now on."""
        for name, more in gradients.items():
            own = getattr(self, name)
            if own is None:
                setattr(self, name, more)
            else:
                add_to(own.device, own, more)


class LossTerm:
    """A term of the loss that a training step minimises.

    Attributes
    ----------
    name : what its measurements are found by.
    needs_depth : whether its frames are rendered with depth; a gradient by depth or transmittance
        is possible only then.
    needs_source : whether it compares with a source view; a view without one leaves it out.
    """

    name: ClassVar[str]
    needs_depth: ClassVar[bool] = False
    needs_source: ClassVar[bool] = False

    def __init__(self, device: Device, options: TrainOptions) -> None:
        self.device, self.options = device, options

    @classmethod
    def is_used(cls, options: TrainOptions) -> bool:
        """Whether trainings with these options, in which nothing is left to decide, have it."""
        return True

    def weight(self, plan: Plan) -> float:
        """Its weight in the steps of a Plan; 0 leaves it out."""
        return 1.0

    def add_to(self, grad: FrameGradient, frame: Frame, image: Array, sample: TrainingSample,
               weight: float) -> Any:
        """Add its gradient to that of the step; returns what it measures, still on the device.

        Parameters
        ----------
        grad : of the step, to which its own gradient is added.
        frame : what was rendered.
        image : real[3, H, W], the frame's image after the view's colour transform.
        sample : what it is compared with.
        weight : of this term in this step, not 0.
        """
        raise NotImplementedError

    def arrays(self, width: int, height: int, last: str) -> list[FrameArray]:
        """What `add_to` allocates for an image, pixels, for estimates of memory; last: the stage
        that uses a gradient by the image up. None, where that is little."""
        return []

    def values(self, measured: list[Any]) -> dict[str, float]:
        """Numbers for the record, from what `add_to` measured in a step's views; waits."""
        return {}
