"""Scores of a merged city, a share of the views in each of several processes.

Every view is scored by itself, so that all shares together are what one process computes, to the
bit where the devices are alike.
"""

import logging
import shutil
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from clsplat.cities.jobs import Job, never
from clsplat.cities.seams import Errors, inspect_views
from clsplat.cities.seams import joined as joined_errors
from clsplat.cities.workers import Workers
from clsplat.device import Device
from clsplat.errors import Interrupted
from clsplat.evaluation.held_out_responses import predicted_responses
from clsplat.evaluation.run import Run
from clsplat.evaluation.views import evaluate_views, final_metrics
from clsplat.gaussians import Gaussians
from clsplat.io.models.ply import read_ply
from clsplat.io.runs.city import CityFolder
from clsplat.io.runs.run import RunFolder
from clsplat.io.scenes.options import SceneOptions
from clsplat.options import RunOptions
from clsplat.scene import Scene, View
from clsplat.training.progress import SilentProgress

FOLDER = "scores"  # of the shares, in the city's folder while they are computed
WORKED = "worked"  # a file there, which is touched after each view
LEAST_PIXELS = 1_000_000  # of a share's views: with fewer, a process begins longer than it scores
MOST_SHARES = 64  # on a cluster, whose workers are not counted before

log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class Scored:
    """The scores of views.

    Attributes
    ----------
    per_view : of the held-out views, see `evaluate_views`, by the index of the view.
    errors : beside the borders, see `inspect_views`; none for a single block.
    """

    per_view: dict[int, dict[str, Any]]
    errors: Errors


@dataclass(frozen=True)
class ScoreJob(Job):
    """Scores every `shares`-th view of a merged city, from the view `share` on.

    Attributes
    ----------
    city : its folder.
    share, shares : this share, and the number of all.
    reference : the PLY file of the reference for seams; None: that of the coarse model.
    """

    city: Path = Path()
    share: int = 0
    shares: int = 1
    reference: Path | None = None

    def run(self, device: Device, progress: SilentProgress | None = None,
            stopping: Callable[[], bool] = never) -> Scored:
        """Compute the scores of the share."""
        city = CityFolder(self.city)
        run, partition = Run.open(city.path), city.partition()
        scene, options, merged = run.scene(), run.options, run.finished_model
        views, held_out = views_of(scene, options)
        chosen = {views[index].name: index for index in range(self.share, len(views), self.shares)}

        def worked(*_: object) -> None:
            if stopping():
                raise Interrupted("it was stopped")
            (self.folder / WORKED).touch()

        per_view = {}
        if held_out:
            per_view = {chosen[scores["name"]]: scores for scores in evaluate_views(
                *run.opened(device, scene, merged), [views[index] for index in chosen.values()],
                worked, final_metrics(options.lpips),
                predicted_responses(scene.views, run.folder.load_exposures()))["per_view"]}

        def inspected() -> Iterator[int]:
            for index in chosen.values():
                worked()
                yield index

        errors: Errors = []
        if len(partition.regions) > 1:
            other = reference_model(city, scene, self.reference)
            errors = inspect_views(device, partition, scene, views, options, merged, other,
                                   inspected())
        return Scored(per_view, errors)


def views_of(scene: Scene, options: SceneOptions) -> tuple[list[View], bool]:
    """The views on which a city is scored, and whether they were held out.

    Parameters
    ----------
    scene : the whole, at the size of the renders.
    options : of the whole.
    """
    train, test = scene.split(options.test_every, options.test_offset)
    return list(test or train), bool(test)


def reference_model(city: CityFolder, scene: Scene, reference: Path | None) -> Gaussians:
    """The Gaussians with which seams are compared, in the frame of the scene."""
    path = reference or RunFolder(city.coarse).model_path
    return read_ply(path, scene.offset).without_spheres()


def score_in_shares(city: CityFolder, options: RunOptions, reference: Path | None,
                    views: Sequence[View], workers: Workers) -> Scored | None:
    """Score the views of a merged city on all workers.

    Parameters
    ----------
    options : of the whole.
    reference : see `ScoreJob`.
    views : those that are scored.
    workers : which score them.

    Returns
    -------
    The scores; None where one process is to compute them: there are few views or one worker, or a
    share has failed.
    """
    pixels = sum(view.camera.width * view.camera.height for view in views)
    shares = min(pixels // LEAST_PIXELS, len(views),
                 MOST_SHARES if workers.scheduler else workers.number)
    if shares < 2:
        return None
    folder = city.path.resolve()
    jobs = [ScoreJob(f"scores {share}", folder / FOLDER / f"{share:03d}", options.device,
                     options.form, city=folder, share=share, shares=shares,
                     reference=reference and reference.resolve()) for share in range(shares)]
    try:
        outcomes = workers.run(jobs, lambda job: None)
    finally:
        shutil.rmtree(folder / FOLDER, ignore_errors=True)
    for outcome in outcomes:
        if not outcome.ok:
            log.warning("%s failed on %s (%s); one process scores all views", outcome.job.name,
                        outcome.worker, outcome.error)
            return None
    return joined([outcome.value for outcome in outcomes])


def joined(shares: Sequence[Scored]) -> Scored:
    """The scores of all views from those of all shares."""
    per_view = {view: scores for share in shares for view, scores in share.per_view.items()}
    return Scored({view: per_view[view] for view in sorted(per_view)},
                  joined_errors([share.errors for share in shares]))
