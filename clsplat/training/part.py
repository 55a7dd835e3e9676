"""What a training has besides its gaussians, its photos and its schedule: its parts.

A part is one object, in one file of `clsplat/training/parts/` or of another package: a term of the
loss, or something that is learned beside the gaussians. It has its own options, decision, arrays on
the device, hooks in a step, state in checkpoints and files of the run. A session, a step and a
checkpoint are loops over parts; a new one changes none of them.

A step on a view calls the hooks in this order; each extends the `ViewPass` that it is given:

    camera -> respond -> (render) -> add_to -> adjoint -> (backward pass) -> learn -> (Adam) -> move

They enqueue work and wait for nothing. The work is recorded and replayed in later steps with other
inputs (device/graph.py), so what differs between steps must be one of the part's `inputs`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray

from clsplat.device import Array
from clsplat.primitives.reduce import add_to
from clsplat.rendering.blend import Exposure
from clsplat.rendering.pipeline import Frame
from clsplat.rendering.project import Gradients

if TYPE_CHECKING:
    from clsplat.densify.grow import Growth
    from clsplat.gaussians import Gaussians
    from clsplat.io.runs.run import RunFolder
    from clsplat.options import TrainOptions
    from clsplat.scene import Scene, View
    from clsplat.schedule.plan import Plan, SceneFacts
    from clsplat.training.model import Model
    from clsplat.training.photos import Thumbnails
    from clsplat.training.session import Session
    from clsplat.training.start.prepare import PreparedScene

Inputs = Mapping[str, Any]  # of a part, in one view of one step
State = Mapping[str, NDArray[Any]]


class Decision(NamedTuple):
    """A decision that was made before training."""

    value: Any
    reason: str  # a sentence that begins with the value and gives the number behind it
    found: Any = None  # what the search for the decision found besides, for the part that needs it


def requested(value: Any) -> Decision:
    """The decision that an option asks for."""
    return Decision(value, f"{value}: requested")


class Survey(NamedTuple):
    """What decisions are made from."""

    scene: Scene  # at the size of training
    views: Sequence[View]  # its training views
    options: TrainOptions  # as the user gave them
    thumbnails: Thumbnails  # small photos of the views


class Now(NamedTuple):
    """A step, as all its views see it."""

    iteration: int  # from 1
    plan: Plan  # the schedule's decisions for it
    progress: float  # the share of the run's steps that were taken before it, 0 to 1
    rates: Mapping[str, float]  # field of the gaussians -> learning rate


@dataclass(frozen=True, eq=False)
class TrainingSample:
    """One view of a training step."""

    view: int  # index of the training view
    camera: Array  # real[27], packed, as it was given
    photo: Array  # uchar[3, H, W], or uchar[4, H, W] with a mask (cl/image_loss.cl)
    # whether a mask of the photo is its own; one that has outliers only does not change which
    # gaussians the view sees
    own_mask: bool = True
    number: int = 1  # how many views have been trained on, with this one


@dataclass(eq=False)
class FrameGradient:
    """Gradients of a loss by the channels of a frame; None is zero."""

    # real[3, H, W], by the image that is compared with the photo; after `adjoint` by the rendered
    image: Array | None = None
    depth: Array | None = None  # real[H, W]
    transmittance: Array | None = None  # real[H, W]

    def add(self, **gradients: Array) -> None:
        """Add gradients, by the names above; this object may overwrite them from now on."""
        for name, more in gradients.items():
            own = getattr(self, name)
            if own is None:
                setattr(self, name, more)
            else:
                add_to(own.device, own, more)


@dataclass(eq=False)
class ViewPass:
    """The forward and the backward pass of one view, as far as they have come."""

    view: int  # index of the training view; an input of the recording
    given: Array  # real[27], the packed camera of the scene
    camera: Array  # real[27], the one that is rendered: `given`, unless a part corrects it
    photo: Array  # uchar[3 or 4, H, W]
    rows: Mapping[str, Array]  # field of the gaussians -> real[N, *row shape]
    # uint[FRAME_COUNTS]; no hook may change what outlives a frame that has failed
    counts: Array
    frozen: Array | None = None  # uint[N], not 0 for gaussians that are not trained; None: all are
    exposure: Exposure | None = None  # what `Renderer.render` makes the compared image with
    frame: Frame = field(init=False)  # the rendered view, from `add_to` on
    grad: FrameGradient = field(default_factory=FrameGradient)
    gradients: Gradients = field(init=False)  # by the gaussians, from `learn` on


class Part:
    """A part of a training; every hook may be left out.

    `session` is the state of the training (training/session.py), `prepared` its scene with all
    decisions, and `survey` what decisions are made from. In a step, `now` is the step as all its
    views see it, `sample` and `work` are a view of it, and `inputs` what `inputs` returned for it.
    """

    name: ClassVar[str]  # key of its state in checkpoints, and of its records
    Options: ClassVar[type | None] = None  # frozen dataclass of its own (config/option.py)
    # whether frames need a depth channel; only then may the loss have a gradient by depth or
    # transmittance
    needs_depth: ClassVar[bool] = False
    needs_pose: ClassVar[bool] = False  # whether `ViewPass.gradients` need pose terms
    # whether a hook in a step waits for the device, to read an array or to write one from the host;
    # steps with such a part are not recorded, and so are slower
    waits: ClassVar[bool] = False
    # whether it makes the training a stage of a larger one, which decides the number of steps and
    # shows the result: then there is no evaluation, no report, and in the end no checkpoint
    is_stage: ClassVar[bool] = False
    resident: bool = True  # whether the arrays among its inputs stay on the device
    # uint[1] on the device, how many of its gradients, one a view, were not finite; None: it learns
    # nothing
    skipped: Array | None = None

    # --- before the first step

    @classmethod
    def decide(cls, survey: Survey) -> dict[str, Decision]:
        """Option -> the decision about it; InputError if an option cannot be met."""
        return {}

    @classmethod
    def is_used(cls, prepared: PreparedScene) -> bool:
        """Whether a training has this part; its options are decided."""
        return True

    def facts(self, facts: SceneFacts, scene: Scene, views: Sequence[View], gaussians: Gaussians | None) -> SceneFacts:
        """Restrict the `facts` for the schedule, of a `scene` and its training `views`, to what is
        trained. `gaussians` are the initial ones; None: they are not known yet."""
        return facts

    def begin(self, session: Session) -> None:
        """Allocate what it needs; `session` has photos, and no gaussians yet."""

    def rows_changed(self, model: Model, growth: Growth | None) -> None:
        """Follow a change of the `model`, after it. `growth` is the round that made its rows;
        None: they are the initial ones, or have moved since."""

    def visits(self, views: Sequence[View]) -> NDArray[Any]:
        """How often each of `views` is trained on, in any unit."""
        return np.ones(len(views))

    # --- between steps; these may wait for the device

    def begin_level(self, session: Session) -> None:
        """Use the photos of another level from now on."""

    def before_step(self, session: Session, plan: Plan) -> dict[str, Any] | None:
        """Do what is due before a step with this plan; returns a record for metrics.jsonl."""
        return None

    def opacities_reset(self, session: Session) -> None:
        """Follow a reset of the opacities."""

    def finish(self, session: Session) -> None:
        """Do what is due once, after the last step of the training."""

    def recentre(self) -> None:
        """Take out of what was learned that which all views have in common; once an epoch."""

    # --- in a step

    def inputs(self, now: Now, sample: TrainingSample) -> Inputs | None:
        """The numbers and arrays that differ from step to step, by name; None: the part is left out
        of this view."""
        return {}

    def read_ahead(self, plan: Plan, view: int, number: int) -> Sequence[int]:
        """Views whose photos `inputs` will need besides `view`; `plan` and `number` are as in `Now`
        and `TrainingSample`."""
        return ()

    def camera(self, work: ViewPass, inputs: Inputs) -> None:
        """Correct `work.camera`."""

    def respond(self, work: ViewPass, inputs: Inputs) -> None:
        """Set `work.exposure`."""

    def add_to(self, work: ViewPass, inputs: Inputs) -> Any:
        """Add the gradient of a term of the loss to `work.grad`; returns what `values` needs, of
        any type, without waiting for the device, or None."""

    def adjoint(self, work: ViewPass, inputs: Inputs) -> None:
        """Take `work.grad.image` back through what `respond` set, and learn from it."""

    def learn(self, work: ViewPass, inputs: Inputs) -> None:
        """Learn from `work.gradients`, or add to them."""

    def move(self, work: ViewPass, inputs: Inputs) -> None:
        """Change gaussians once Adam has moved them."""

    # --- results

    def values(self, measured: list[Any]) -> dict[str, float]:
        """Numbers for the record from `measured`, what `add_to` returned for each view; waits."""
        return {}

    def corrected(self, views: Sequence[View]) -> Sequence[View]:
        """The training `views`, at any size, with what was learned of their cameras; waits."""
        return views

    def state(self) -> State:
        """Host arrays by name, for a checkpoint; waits."""
        return {}

    def load(self, state: State, session: Session) -> None:
        """Go on from what `state` returned; KeyError names what it lacks."""

    def write(self, run: RunFolder, session: Session) -> None:
        """Write its files into the folder of a finished `run`."""


def overriding(parts: Sequence[Part], hook: str) -> list[Part]:
    """The parts that do something at a hook."""
    return [part for part in parts if getattr(type(part), hook) is not getattr(Part, hook)]
