"""The dense points of a city, by this process, or by another one during the coarse run."""

import time
from collections.abc import Callable
from dataclasses import dataclass

from clsplat.cities.city import City
from clsplat.cities.jobs import Job
from clsplat.device import Device
from clsplat.errors import Interrupted
from clsplat.io.models.ply import write_ply
from clsplat.io.runs.city import CityFolder
from clsplat.training.progress import SilentProgress
from clsplat.training.start.initialise import first_gaussians
from clsplat.training.start.prepare import prepare


def find_dense_gaussians(city: City, progress: SilentProgress | None = None) -> None:
    """Write CITY/dense.ply, if one run of the whole scene would begin at dense points.

    They are found once for the whole, as photos are in several blocks, which begin with those that
    stand in gaps of the coarse model (cities/choose.py). A city that is cut already stays as it
    is. InputError if they were requested, and cannot be had.
    """
    if city.folder.has_partition or city.folder.dense.is_file():
        return
    prepared = prepare(city.pinhole, city.options)
    if prepared.options.init != "dense":
        return
    gaussians = first_gaussians(city.device, prepared, progress or SilentProgress(), enter=False).gaussians
    write_ply(
        city.folder.dense, gaussians.with_sh_degree(0).scaled(prepared.scene.unit), city.scene.offset, sphere=True
    )


@dataclass(frozen=True)
class DenseJob(Job):
    """The search for the dense points of a city that has begun; returns the time at which it began,
    and the seconds that it took."""

    def run(
        self, device: Device, progress: SilentProgress | None = None, stopping: Callable[[], bool] = lambda: False
    ) -> tuple[float, float]:
        """As `Job.run`; nothing is saved where it is stopped."""
        began = time.time()
        find_dense_gaussians(City.open(CityFolder(self.folder), device=device), progress or _Stopping(stopping))
        return began, time.time() - began


def search_of(city: City) -> DenseJob:
    """The search for the dense points of a city, whose photos it finds without distortion."""
    city.pinhole  # noqa: B018  (two processes must not write the same photos)
    return DenseJob(
        "dense points",
        city.folder.path.resolve(),
        str(city.options.device),
        str(city.options.form),
        done=city.folder.dense,
    )


class _Stopping(SilentProgress):
    """Raises Interrupted at the next phase once it is told to stop."""

    def __init__(self, stopping: Callable[[], bool]) -> None:
        super().__init__()
        self._stopping = stopping

    def phase(self, text: str) -> None:
        """As in `SilentProgress`."""
        if self._stopping():
            raise Interrupted("the search for dense points was stopped")
        super().phase(text)
