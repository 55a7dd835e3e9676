"""A session before its first step: what the device finds, and what threads read meanwhile."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, closing
from dataclasses import replace
from pathlib import Path
from typing import Any

from clsplat.device import Device, Kernel
from clsplat.gaussians import Gaussians
from clsplat.io.models.ply import START
from clsplat.io.records import digest_of
from clsplat.io.runs.run import PART_OF_CITY
from clsplat.io.scenes.read import fingerprint
from clsplat.loss import image_loss
from clsplat.optimise import adam_kernels
from clsplat.primitives import compact, gather, reduce, sort
from clsplat.rendering import bin, blend, cull, project
from clsplat.scene import Scene
from clsplat.training import frequency
from clsplat.training.parts import parts_of
from clsplat.training.photos import THREADS, Photos, begin_checks, begin_photos, photo_array
from clsplat.training.progress import SilentProgress
from clsplat.training.session import Session
from clsplat.training.start.initialise import Start, first_gaussians
from clsplat.training.start.prepare import PreparedScene


def begin(
    prepared: PreparedScene,
    device: Device,
    folder: Path,
    progress: SilentProgress,
    gaussians: Gaussians | None = None,
    level: float = 0.0,
) -> tuple[Session, float]:
    """A session that is ready for its first step, and the seconds in which its gaussians were
    found; `gaussians` and `level` are those of a run that goes on.

    Photos are decoded and kernels compiled in threads while the device searches for dense points;
    no thread outlives an error. InputError where a photo is damaged, also one of the test views, at
    which the run would stop at its first evaluation.
    """
    levels = prepared.decisions.values["levels"]
    level = level or (levels or [0.0])[0]  # 0: only the schedule knows
    with ExitStack() as reading:
        threads = ThreadPoolExecutor(THREADS)
        reading.callback(threads.shutdown, wait=False, cancel_futures=True)
        checks = reading.enter_context(closing(begin_checks(prepared.test_views)))
        begun = (
            (level, reading.enter_context(closing(begin_photos(device, prepared.train_views, level, folder))))
            if level
            else None
        )
        if not gaussians:
            device.build_ahead(first_kernels(prepared, device), threads)
        start = Start(gaussians, 0.0) if gaussians else first_gaussians(device, prepared, progress)
        prepared = replace(prepared, given=(*prepared.given, *start.parts))
        schedule = prepared.schedule(start.gaussians)
        progress.phase("reading photos")
        checks.wait()
        checks.close()
        photos = reading.enter_context(
            closing(Photos(device, prepared.train_views, schedule.levels, folder=folder, level=level, begun=begun))
        )
        session = Session(prepared, device, start.gaussians, photos, schedule, progress)
        reading.pop_all()
        threads.shutdown(wait=False)
    return session, start.seconds


def trained_on(scene: Scene, init: str, device: Device, is_stage: bool = False) -> dict[str, Any]:
    """What a run is trained on and begins with (the option `init`), for its options.json."""
    return {
        "scene": scene.path,
        "fingerprint": fingerprint(scene),
        START: digest_of(init),
        "opencl_device": device.name,
        "kernel_form": device.form,
        "kernel_sizes": device.tuning,
        "extent": scene.extent,
        "offset": scene.offset.tolist(),
        PART_OF_CITY: is_stage,
    }


def first_kernels(prepared: PreparedScene, device: Device) -> Iterator[tuple[Kernel, blend.Defines]]:
    """The kernels that the first steps launch, one of each program, with the constants of their
    builds, so that threads can compile them before.

    One that is missing here, such as a part's own, is compiled when it is launched, and one that is
    not launched has cost time of a thread.
    """
    options, parts = prepared.options, parts_of(prepared)
    own_masks = any(view.may_have_mask for view in prepared.train_views)
    projecting = project.project_defines(options.sh_degree, options.antialiased)
    yield cull.CULL, projecting
    yield compact.COMPACT, ()
    yield project.PROJECT, project.of_degree(projecting, 0)
    yield bin.COUNT_TILES, ()
    yield adam_kernels.STEP, adam_kernels.adam_defines(dict(projecting)["SH_REST"], 0)
    if bin.NEEDS_ORDER.of(device):
        yield sort.SCATTER, sort.SORT_DEFINES
    if options.exposure == "on":
        yield blend.BLEND, (*blend.blend_defines(False), *blend.response_defines(options.vignetting == "on"))
    for with_depth in sorted({False, *(part.needs_depth for part in parts)}):
        yield blend.ADJOINT, blend.blend_defines(with_depth)
        yield (
            project.ADJOINT,
            (
                *project.of_degree(projecting, 0),
                *project.adjoint_choices(False, True, own_masks, any(part.needs_pose for part in parts)),
                *project.summed_choices((("WITH_DEPTH", int(with_depth)),)),
            ),
        )
    for planes in sorted({photo_array(view).shape[0] for view in prepared.train_views}):
        yield image_loss.VALUE, image_loss.mask_defines(planes > 3)
    yield frequency.LARGEST, ()
    yield reduce.SUM_COLUMNS, ()
    yield gather.GATHER, ()
    yield project.PROJECT, project.of_degree(projecting, options.sh_degree)  # an evaluation
