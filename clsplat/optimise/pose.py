"""Learned corrections of the poses of training views, as those that a scene brings are not exact
(cl/pose.cl)."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.camera import Camera
from clsplat.constants import CAMERA_REALS, FRAME_COUNTS, POSE_BLOCK, POSE_REALS
from clsplat.device import Array, Device, Forms, Kernel, each, groups, items
from clsplat.placement.corrections import Correction, without_common_motion

LEARNED = ("poses", "m", "v", "steps")
WARM_UP = 0.3  # of the run: so long poses stay, as the first gaussians tell nothing of them
DECAY = 0.05  # the share of the rate that is left at the last step
RATE = 5e-4  # radians, or shares of the depth, right after the warm-up
PULL = 100.0  # weight of half the squared correction in the loss, radians

_ROWS, _CAMERA = ("real", "V", POSE_REALS), ("real", CAMERA_REALS)
_PARTIALS = ("real", "P", POSE_REALS)
APPLY = Kernel(
    "pose.cl", "pose_apply", items("1"), view="uint", depth="real", camera=_CAMERA, poses=_ROWS, corrected=_CAMERA
)
SUMS = Kernel(
    "pose.cl",
    "pose_sums",
    Forms(item=each("blocks"), group=groups("blocks", "SCAN_GROUP")),
    rows="uint",
    blocks="uint",
    counts=("uint", FRAME_COUNTS),
    pose_terms=("real", "T", POSE_REALS),
    partials=_PARTIALS,
)
STEP = Kernel(
    "pose.cl",
    "pose_step",
    groups("1", "16"),
    view="uint",
    rate="real",
    pull="real",
    depth="real",
    blocks="uint",
    counts=("uint", FRAME_COUNTS),
    camera=_CAMERA,
    partials=_PARTIALS,
    poses=_ROWS,
    m=_ROWS,
    v=_ROWS,
    steps=("uint", "V"),
    skipped=("uint", 1),
)


class Poses:
    """Corrections of the poses of V views, and their Adam.

    Parameters
    ----------
    device, cameras : of the gaussians; of the views, as they were given.
    depth : world units; at this distance a turn and a shift by the same number move what is seen by
        as much (`placement.corrections.typical_depth`).
    pull : weight in the loss of half the sum of squares of a view's six numbers.

    Attributes
    ----------
    poses, m, v : real[V, 6], the corrections (cl/pose.cl) and their Adam moments.
    steps : uint[V], steps of each view.
    skipped : uint[1], steps that were left out because their gradient was not finite.
    corrected : real[27], the packed camera of the view at hand.
    """

    def __init__(self, device: Device, cameras: Sequence[Camera], depth: float, pull: float = PULL) -> None:
        self.device, self.cameras, self.depth, self.pull = device, cameras, depth, pull
        self.poses, self.m, self.v = (device.zeros((len(cameras), POSE_REALS)) for _ in range(3))
        self.steps, self.skipped = (device.zeros(count, np.uint32) for count in (len(cameras), 1))
        self.corrected = device.zeros(CAMERA_REALS)

    def apply(self, view: int, camera: Array) -> Array:
        """`corrected` for a view's packed camera real[27], as it was given, for an image of any
        size; the next call overwrites it on the device."""
        self.device.launch(
            APPLY, view=view, depth=self.depth, camera=camera, poses=self.poses, corrected=self.corrected
        )
        return self.corrected

    def step(self, view: int, rate: float, camera: Array, pose_terms: Array, counts: Array) -> None:
        """Take one step of Adam on the pose of a view; does not wait for the device.

        `rate` is in radians, `pose_terms` are real[T, 6] of `project_adjoint`. A gradient that is
        not finite changes nothing, and is counted in `skipped`; a failed frame changes nothing.
        """
        rows = len(pose_terms)
        blocks = max(1, -(-rows // POSE_BLOCK))
        partials = self.device.empty((blocks, POSE_REALS))
        self.device.launch(SUMS, rows=rows, blocks=blocks, counts=counts, pose_terms=pose_terms, partials=partials)
        self.device.launch(
            STEP,
            view=view,
            rate=rate,
            pull=self.pull,
            depth=self.depth,
            blocks=blocks,
            counts=counts,
            camera=camera,
            partials=partials,
            poses=self.poses,
            m=self.m,
            v=self.v,
            steps=self.steps,
            skipped=self.skipped,
        )

    def corrections(self) -> list[Correction]:
        """The corrections of the views; waits for the device."""
        rows = self.poses.download().astype(np.float64)
        return [Correction(row[:3], self.depth * row[3:]) for row in rows]

    def recentre(self) -> None:
        """Take the mean rigid motion of all cameras out of the corrections; waits.

        The gaussians can follow a motion that all cameras have in common, so nothing but the pull
        prevents it; but held-out views keep the poses that they were given.
        """
        corrections = self.corrections()
        if not any(each.turn.any() or each.shift.any() for each in corrections):
            return  # in the warm-up; rounding would move them
        kept = without_common_motion(self.cameras, corrections, self.depth)
        self.poses.write(np.array([[*each.turn, *(each.shift / self.depth)] for each in kept]))

    def download(self) -> dict[str, NDArray[Any]]:
        """All that was learned, host arrays by name, for `upload`."""
        return {name: getattr(self, name).download() for name in LEARNED}

    def upload(self, arrays: dict[str, NDArray[Any]]) -> None:
        """Continue from what `download` returned."""
        for name in LEARNED:
            getattr(self, name).write(arrays[name])


def pose_rate(progress: float) -> float:
    """The learning rate of poses at a progress of 0 to 1: 0 in the warm-up, then RATE, radians,
    which decays exponentially."""
    after = (progress - WARM_UP) / (1 - WARM_UP)
    return float(RATE * DECAY ** min(1.0, after)) if after >= 0 else 0.0
