"""A session before its first step: what the device finds, and what threads read meanwhile."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, closing
from dataclasses import replace
from pathlib import Path

from clsplat.device import Device
from clsplat.gaussians import Gaussians
from clsplat.training.photos import THREADS, Photos, begin_checks, begin_photos
from clsplat.training.progress import SilentProgress
from clsplat.training.session import Session
from clsplat.training.start.initialise import Start, first_gaussians
from clsplat.training.start.kernels import first_kernels
from clsplat.training.start.prepare import PreparedScene


def begin(prepared: PreparedScene, device: Device, folder: Path, progress: SilentProgress,
          gaussians: Gaussians | None = None, level: float = 0.0) -> tuple[Session, float]:
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
        begun = (level, reading.enter_context(closing(begin_photos(
            device, prepared.train_views, level, folder)))) if level else None
        if not gaussians:
            device.build_ahead(first_kernels(prepared, device), threads)
        start = (Start(gaussians, 0.0) if gaussians else
                 first_gaussians(device, prepared, progress))
        prepared = replace(prepared, given=(*prepared.given, *start.parts))
        schedule = prepared.schedule(start.gaussians)
        progress.phase("reading photos")
        checks.wait()
        checks.close()
        photos = reading.enter_context(closing(Photos(
            device, prepared.train_views, schedule.levels, folder=folder, level=level,
            begun=begun)))
        session = Session(prepared, device, start.gaussians, photos, schedule, progress)
        reading.pop_all()
        threads.shutdown(wait=False)
    return session, start.seconds
