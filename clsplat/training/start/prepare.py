"""From a scene as it was read to one that is ready for training, with all decisions made."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

from clsplat.device import Device
from clsplat.errors import InputError
from clsplat.gaussians import Gaussians
from clsplat.io.photos.depth import with_depths
from clsplat.options import ScheduledOptions, TrainOptions
from clsplat.scene import Scene, View
from clsplat.schedule import Schedule, schedule_of
from clsplat.training.part import Part
from clsplat.training.start.decisions import Decisions, find_decisions
from clsplat.training.start.thumbnails import Thumbnails


@dataclass(frozen=True, eq=False)
class PreparedScene:
    """A scene that is ready for training.

    Attributes
    ----------
    scene : with photos at the size of training; its unit is its extent, so that steps do not depend
        on the unit of the coordinates.
    train_views, test_views : the training views and the held-out views.
    decisions : all that was decided.
    thumbnails : small photos of the training views.
    given : parts besides those that the options ask for.
    """

    scene: Scene
    train_views: tuple[View, ...]
    test_views: tuple[View, ...]
    decisions: Decisions
    thumbnails: Thumbnails
    given: tuple[Part, ...] = ()

    @property
    def options(self) -> TrainOptions:
        """The options after all decisions."""
        return self.decisions.options

    @property
    def near(self) -> float:
        """Distance of the near plane, in units of the scene."""
        return self.scene.near(self.options.near)

    def schedule(self, gaussians: Gaussians, options: ScheduledOptions | None = None) -> Schedule:
        """A new schedule.

        Parameters
        ----------
        gaussians : the initial ones.
        options : instead of `self.options`.
        """
        options = options or self.options
        facts = replace(self.decisions.facts, count=gaussians.count)
        for part in self.given:
            facts = part.facts(facts, self.scene, self.train_views, gaussians)
        return schedule_of(options.schedule)(options, facts)


def prepare(scene: Scene, options: TrainOptions, device: Device | None = None,
            parts: Iterable[Part] = ()) -> PreparedScene:
    """Prepare a scene for training; InputError where that is impossible.

    Parameters
    ----------
    scene : as it was read.
    options : as the user gave them.
    device : where it trains.
    parts : besides those that the options ask for.
    """
    parts = tuple(parts)
    scene = with_depths(scene, options.depth)
    scene = scene.reduced(options.downscale, options.max_resolution).normalised()
    if len(scene.views) < 2:
        raise InputError(f"{scene.name}: has a single photo; depth needs at least two from "
                         "different places, and 20 or more make a good model")
    train_views, test_views = scene.split(options.test_every, options.test_offset)
    if options.robust == "on":
        train_views = tuple(replace(view, weighed=True) for view in train_views)
    if not train_views:
        raise InputError(f"{scene.name}: --test-every {options.test_every} holds out every "
                         "view; use a larger number, or none")
    if options.test_offset and not test_views:
        raise InputError(f"{scene.name}: --test-offset {options.test_offset} holds out none of its "
                         f"{len(scene.views)} views; use a smaller number")
    thumbnails = Thumbnails(train_views)
    return PreparedScene(scene, train_views, test_views, find_decisions(
        scene, train_views, options, device, thumbnails, parts), thumbnails, parts)
