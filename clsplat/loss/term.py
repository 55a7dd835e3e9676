"""A term of the training loss, and what a step passes to it.

A new term is one file with a subclass of `LossTerm`, and one line in `terms.TERMS`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

from clsplat.device import Array, ArraySpec, Device
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
    photo : uchar[3 or 4, H, W], the source view's photo.
    geometries : real[P, 12], of all pairs of views (`reproject.pack_pairs`).
    colours : real[P, 12], transforms of a source photo's display values to the reference photo's.
    pair : the row of this pair in both.
    """

    photo: Array
    geometries: Array
    colours: Array
    pair: int


@dataclass(frozen=True, eq=False)
class TrainingSample:
    """One view of a training step.

    Attributes
    ----------
    view : index of the training view.
    camera : real[27], packed.
    photo : uchar[3, H, W], or uchar[4, H, W] with a mask (cl/image_loss.cl).
    source : a source view, if a term of this step compares with one.
    depth : real[H, W], its depth map, 0 where there is none; None: the view has no map.
    own_mask : whether a mask of the photo is its own; one that has outliers only does not change
        which gaussians the view sees.
    layers : uchar[3 or 7, H, W], what surrounds a block (cl/include/layers.h); None: nothing.
    """

    view: int
    camera: Array
    photo: Array
    source: SourceView | None = None
    depth: Array | None = None
    own_mask: bool = True
    layers: Array | None = None


@dataclass(eq=False)
class FrameGradient:
    """Gradients of a loss by the channels of a frame; None is zero.

    Attributes
    ----------
    image : real[3, H, W], by the image after the view's colour transform.
    depth, transmittance : real[H, W].
    """

    image: Array | None = None
    depth: Array | None = None
    transmittance: Array | None = None

    def add(self, **gradients: Array) -> None:
        """Add gradients, by the names above; this object may overwrite them from now on."""
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
    name : key of what it measures.
    needs_depth : whether frames need a depth channel; only then may it have a gradient by depth or
        transmittance.
    needs_source : whether it needs a source view; it is left out for views that have none.
    needs_map : whether it needs a depth map; it is left out for views that have none.
    waits : whether `add_to` waits for the device, to read an array or to write one from the host;
        steps with such a term are not recorded (device/graph.py), and so are slower.
    """

    name: ClassVar[str]
    needs_depth: ClassVar[bool] = False
    needs_source: ClassVar[bool] = False
    needs_map: ClassVar[bool] = False
    waits: ClassVar[bool] = False

    def __init__(self, device: Device, options: TrainOptions) -> None:
        self.device, self.options = device, options

    @classmethod
    def is_used(cls, options: TrainOptions) -> bool:
        """Whether a training with these options has this term; no option is `auto` any more."""
        return True

    def weight(self, plan: Plan) -> float:
        """Its weight in a step; with 0 it is left out."""
        return 1.0

    def add_to(self, grad: FrameGradient, frame: Frame, image: Array, sample: TrainingSample,
               weight: float) -> Any:
        """Add its gradient to that of the step.

        Parameters
        ----------
        grad : gradient of the step, which is changed in place.
        frame : the rendered view.
        image : real[3, H, W], the frame's image after the view's colour transform.
        sample : the view's photo, and what else it is compared with.
        weight : of this term in this step, not 0. Unless the term `waits`, it is passed to a kernel
            as it is: later steps have other weights, and enqueue the same work.

        Returns
        -------
        What `values` needs, of any type, without waiting for the device.
        """
        raise NotImplementedError

    def arrays(self, width: int, height: int, last: str) -> list[FrameArray]:
        """The short-lived arrays that `add_to` allocates for an image, except small ones, to
        estimate memory.

        Parameters
        ----------
        width, height : size of the image, pixels.
        last : the last stage that reads the gradient by the image.
        """
        return []

    def results(self, width: int, height: int) -> list[ArraySpec]:
        """The arrays of `Device.result` that `add_to` allocates for an image of this size."""
        return []

    def values(self, measured: list[Any]) -> dict[str, float]:
        """Numbers for the record, from what `add_to` returned for each view of a step; waits."""
        return {}
