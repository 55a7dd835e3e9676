"""Scores of a merged city, a share of the views in each of several processes.

    python -m clsplat.city.scoring CITY SHARE SHARES [REFERENCE]

writes one share; `clsplat.distribute` starts it on every device. Every view is scored by itself, so
that all shares together are what one process computes, to the bit where the devices are alike.
"""

import json
import logging
import shutil
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from clsplat.city.seams import Strips, inspect_views
from clsplat.device import Device
from clsplat.distribute import Task, Workers
from clsplat.evaluation.held_out_responses import predicted_responses
from clsplat.evaluation.run import Run
from clsplat.evaluation.views import evaluate_views, final_metrics
from clsplat.gaussians import Gaussians
from clsplat.io.atomic import replacing
from clsplat.io.lock import note_work
from clsplat.io.models.ply import read_ply
from clsplat.io.runs.city import CityFolder
from clsplat.io.runs.run import RunFolder
from clsplat.options import TrainOptions
from clsplat.scene import Scene, View
from clsplat.training.block import device_of_tasks

FOLDER = "scores"  # of the shares, in the city's folder while they are computed
LEAST_PIXELS = 1_000_000  # of a share's views: with fewer, a process begins longer than it scores
MOST_SHARES = 64  # on a cluster, whose workers are not counted before

log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class Scored:
    """The scores of views.

    Attributes
    ----------
    per_view : of the held-out views, see `evaluate_views`.
    strips : of all views that are inspected for seams; None for a single block.
    """

    per_view: list[dict[str, Any]]
    strips: Strips | None


def views_of(scene: Scene, options: TrainOptions) -> tuple[list[View], bool]:
    """The views on which a city is scored, and whether they were held out.

    Parameters
    ----------
    scene : the whole, at the size of the renders.
    options : of the whole.
    """
    train, test = scene.split(options.test_every, options.test_offset)
    return list(test or train), bool(test)


def score_share(city: CityFolder, share: int, shares: int, reference: Path | None, device: Device
                ) -> None:
    """Score every `shares`-th view of a merged city, from the view `share` on, and write the file.

    Parameters
    ----------
    reference : the PLY file of the reference for seams; None: that of the coarse model.
    """
    run, partition = Run.open(city.path), city.partition()
    scene, options, merged = run.scene(), run.options, run.finished_model
    views, held_out = views_of(scene, options)
    chosen = {views[index].name: index for index in range(share, len(views), shares)}
    folder = done_file(city, share).parent
    per_view = {}
    if held_out:
        per_view = {chosen[scores["name"]]: scores for scores in evaluate_views(
            *run.opened(device, scene, merged), [views[index] for index in chosen.values()],
            lambda *_: note_work(folder), final_metrics(options.lpips),
            predicted_responses(scene.views, run.folder.load_exposures()))["per_view"]}

    def inspected() -> Iterator[int]:
        for index in chosen.values():
            note_work(folder)
            yield index

    arrays = {}
    if len(partition.regions) > 1:
        other = reference_model(city, scene, reference)
        arrays = inspect_views(device, partition, scene, views, options, merged, other,
                               inspected()).arrays()
    with replacing(done_file(city, share)) as file:
        np.savez(file, per_view=np.array(json.dumps(per_view)),
                 **arrays)  # type: ignore[arg-type]  # none of them is named allow_pickle


def reference_model(city: CityFolder, scene: Scene, reference: Path | None) -> Gaussians:
    """The Gaussians with which seams are compared, in the frame of the scene."""
    path = reference or RunFolder(city.coarse).model_path
    return read_ply(path, scene.offset).without_spheres()


def done_file(city: CityFolder, share: int) -> Path:
    """The file of a share."""
    return city.path / FOLDER / f"{share:03d}" / "scores.npz"


def score_in_shares(city: CityFolder, reference: Path | None, views: Sequence[View],
                    workers: Workers) -> Scored | None:
    """Score the views of a merged city on all workers.

    Parameters
    ----------
    reference : as for `score_share`.
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
    shutil.rmtree(city.path / FOLDER, ignore_errors=True)  # of another model
    try:
        outcomes = workers.run([Task(f"scores {share}", (
            str(city.path.resolve()), str(share), str(shares),
            *((str(reference.resolve()),) if reference else ())), done_file(city, share))
            for share in range(shares)], program="clsplat.city.scoring")
        for outcome in outcomes:
            if not outcome.ok:
                log.warning("%s failed on %s (%s); one process scores all views",
                            outcome.task.name, outcome.worker, outcome.message)
                return None
        return joined([done_file(city, share) for share in range(shares)])
    finally:
        shutil.rmtree(city.path / FOLDER, ignore_errors=True)


def joined(files: Sequence[Path]) -> Scored:
    """The scores of all views from the files of all shares."""
    per_view: dict[int, dict[str, Any]] = {}
    parts = []
    for path in files:
        with np.load(path) as arrays:
            parts.append(dict(arrays))
        per_view |= {int(view): scores
                     for view, scores in json.loads(str(parts[-1].pop("per_view"))).items()}
    return Scored([per_view[view] for view in sorted(per_view)],
                  Strips.joined(parts) if parts[0] else None)


def main(folder: str, share: str, shares: str, reference: str = "") -> None:
    """Compute one share on the device that CLSPLAT_DEVICE names, else on that of the city."""
    city = CityFolder(folder)
    options = Run.open(city.path).options
    device = device_of_tasks(options.device, options.form)
    score_share(city, int(share), int(shares), Path(reference) if reference else None, device)


if __name__ == "__main__":
    main(*sys.argv[1:])
