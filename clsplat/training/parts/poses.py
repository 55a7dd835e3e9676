"""Corrections of the poses of training views, learned beside the gaussians."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

from clsplat.io.runs.run import RunFolder, write_poses
from clsplat.optimise.options import PoseOptions
from clsplat.optimise.pose import LEARNED, Poses, pose_rate
from clsplat.placement.corrections import Correction, typical_depth
from clsplat.training.part import Inputs, Now, Part, State, TrainingSample, ViewPass

if TYPE_CHECKING:
    from clsplat.scene import View
    from clsplat.training.session import Session
    from clsplat.training.start.prepare import PreparedScene


class CameraPoses(Part):
    """Renders each view from its corrected pose, and learns the correction."""

    name = "pose"
    Options = PoseOptions
    needs_pose = True
    poses: Poses

    @classmethod
    def is_used(cls, prepared: PreparedScene) -> bool:
        return prepared.options.poses == "on"

    def begin(self, session: Session) -> None:
        cameras = [view.camera for view in session.train_views]
        self.poses = Poses(session.device, cameras, typical_depth(cameras, session.scene.points))
        self.skipped = self.poses.skipped

    def recentre(self) -> None:
        self.poses.recentre()

    def inputs(self, now: Now, sample: TrainingSample) -> Inputs:
        return {"rate": pose_rate(now.progress)}

    def camera(self, work: ViewPass, inputs: Inputs) -> None:
        work.camera = self.poses.apply(work.view, work.given)

    def learn(self, work: ViewPass, inputs: Inputs) -> None:
        assert work.gradients.pose_terms is not None  # `needs_pose`
        self.poses.step(work.view, inputs["rate"], work.given, work.gradients.pose_terms, work.counts)

    def corrected(self, views: Sequence[View]) -> list[View]:
        return [
            replace(view, camera=correction.applied(view.camera))
            for view, correction in zip(views, self.poses.corrections())
        ]

    def state(self) -> State:
        return self.poses.download()

    def load(self, state: State, session: Session) -> None:
        self.poses.upload({name: state[name] for name in LEARNED})

    def write(self, run: RunFolder, session: Session) -> None:
        """Write poses.json, with shifts in world units."""
        write_poses(
            run.path,
            {
                view.name: Correction(each.turn, each.shift * session.scene.unit)
                for view, each in zip(session.train_views, self.poses.corrections())
            },
        )
