"""The joint training of a city: its last steps, in which the whole is trained on one device.

Blocks learn apart from each other, under surroundings that are those of the coarse run. Where a
device holds the whole model, steps on whole photos remove what that leaves: seams, and gaussians
that only one block needed. The training begins at points of the blocks' gaussians and at dense
points, as one run does: with the shapes and opacities of the blocks it ends in a worse model
(docs/evidence/cities.md).
"""

import dataclasses
import filecmp
import os
import shutil
from typing import Any

import numpy as np

from clsplat.cities.city import City
from clsplat.cities.cut import JOINT
from clsplat.cities.merge import Merged
from clsplat.cities.scene import Stage
from clsplat.errors import InputError
from clsplat.gaussians import Gaussians
from clsplat.io.models.ply import start_of, write_ply
from clsplat.io.models.values import colours_of, to_bytes
from clsplat.io.records import digest_of
from clsplat.io.runs.city import PARTITION
from clsplat.io.runs.run import RunFolder
from clsplat.options import TrainOptions, of_file, resolve
from clsplat.partition.input import world_of
from clsplat.training.loop import resume, train
from clsplat.training.part import Part
from clsplat.training.parts.exposures import PhotoResponses
from clsplat.training.progress import SilentProgress


def train_jointly(city: City, merged: Merged, progress: SilentProgress | None = None) -> Merged:
    """Train a city as a whole in CITY/joint, or continue that.

    That of another merged model, or of another partition without one, is removed. Returns the
    blocks with the gaussians that now lie in their cells; `merged` if the partition has no joint
    training. Raises Interrupted, with the state saved, and DeviceError for a model too large."""
    folder, scene = city.folder, city.scene
    given, run = folder.read_partition().get(JOINT), RunFolder(folder.joint)
    if not given:
        shutil.rmtree(run.path, ignore_errors=True)
        return merged
    begin_with(city, merged.gaussians)
    if not run.has_model:
        together = joint_options(city, given, merged.count)
        parts: list[Part] = [Stage()]
        if together.exposure == "on":
            parts.append(PhotoResponses(RunFolder(folder.coarse).load_exposures()))
        with run.locked():
            start = resume if run.is_begun else train
            start(dataclasses.replace(city.pinhole, notes=()), together, city.device,
                  run if run.is_begun else RunFolder.create(folder.joint), progress, parts=parts)
    if (began := start_of(run.model_path)) and began != digest_of(folder.joint_start):
        raise InputError(f"{run.path}: is the joint training of another city or partition, as it "
                         f"did not begin at {folder.joint_start}; remove it, and give the same "
                         "command again")
    gaussians = run.load_model(scene.offset)
    owner = folder.partition(scene).owner(world_of(scene, gaussians.positions))
    order = np.argsort(owner, kind="stable")
    counts = np.bincount(owner, minlength=len(merged.shares))
    return dataclasses.replace(
        merged, gaussians=Gaussians({name: rows[order] for name, rows in gaussians.rows.items()},
                                    gaussians.sh_degree),
        shares=tuple(dataclasses.replace(share, gaussians=int(counts[share.block]))
                     for share in merged.shares))


def begin_with(city: City, merged: Gaussians) -> None:
    """Write the points at which the joint training begins; remove that of other ones.

    They are half of the points of the merged gaussians and half of the dense points of the city,
    drawn at random; all of the former in a city without dense points.
    """
    folder, dense = city.folder, city.dense_gaussians(0)
    rng = np.random.default_rng([city.options.seed, 0])
    parts = [merged, dense] if dense else [merged]
    chosen = [rng.random(part.count) < 1 / len(parts) for part in parts]
    positions, constant = (np.concatenate([part.rows[name][which]
                                           for part, which in zip(parts, chosen)])
                           for name in ("positions", "sh_constant"))
    new = folder.joint_start.with_suffix(".new.ply")
    write_ply(new, Gaussians.from_points(positions, to_bytes(255 * colours_of(constant)),
                                         sh_degree=0), city.scene.offset)
    if not (folder.joint_start.is_file() and filecmp.cmp(new, folder.joint_start, shallow=False)):
        shutil.rmtree(folder.joint, ignore_errors=True)
    os.replace(new, folder.joint_start)


def joint_options(city: City, given: Any, count: int) -> TrainOptions:
    """The options of the joint training, from those `given` in partition.json.

    A limit of gaussians is one of each block, so the merged model of `count` may have more; it does
    not grow then. The same views are held out as of one run."""
    path = city.folder.path / PARTITION
    if not isinstance(given, dict):
        raise InputError(f"{path}: damaged ({JOINT} is {str(given)[:20]!r}); remove it, and make "
                         f"it with `clsplat partition {city.folder.path}`")
    joint = resolve(of_file(str(path), given), {"init": str(city.folder.joint_start)})
    most = joint.max_gaussians and max(joint.max_gaussians, count)
    return dataclasses.replace(joint, max_gaussians=most, test_every=city.options.test_every,
                               test_offset=city.options.test_offset)
