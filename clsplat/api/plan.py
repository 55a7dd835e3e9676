"""`clsplat.plan`: the decisions of a training, and a forecast of its memory and time."""

from dataclasses import dataclass
from os import PathLike

from clsplat.api.options import TrainOptions
from clsplat.api.trainer import opened_training
from clsplat.device import Device
from clsplat.estimate.forecast import forecast
from clsplat.report.notebook import table
from clsplat.scene import Scene
from clsplat.schedule.plan import Schedule
from clsplat.training.start.prepare import prepare


@dataclass(frozen=True)
class Forecast:
    """The result of `clsplat.plan`.

    Attributes
    ----------
    reasons : decision -> a sentence that begins with the value and gives the number behind it.
    steps : length of the training.
    gaussians : the largest number of gaussians.
    memory_bytes : the largest memory on the device.
    seconds : of training on this device.
    """

    reasons: dict[str, str]
    steps: int
    gaussians: int
    memory_bytes: int
    seconds: float

    def _repr_html_(self) -> str:
        return table(
            {
                **{name.replace("_", " "): text for name, text in self.reasons.items()},
                "steps": f"{self.steps:,}",
                "gaussians": f"{self.gaussians:,}",
                "memory": f"{self.memory_bytes / 2**20:,.0f} MiB",
                "time": f"{self.seconds:,.0f} s",
            }
        )


def plan(
    scene: Scene | str | PathLike[str],
    options: TrainOptions | None = None,
    *,
    device: Device | None = None,
    schedule: type[Schedule] | None = None,
) -> Forecast:
    """Decide what a training needs, and forecast its memory and time, as `clsplat plan` does.

    It takes a few real steps on the device.

    Parameters
    ----------
    scene, options, device, schedule : as for `clsplat.Trainer`.

    Raises
    ------
    clsplat.ClsplatError : if the scene or an option cannot be used, or the steps do not fit the
        device.
    """
    data, chosen, opened = opened_training(scene, options, device, schedule)
    prepared = prepare(data, chosen, opened)
    found = forecast(prepared, opened)
    return Forecast(
        {**prepared.decisions.reasons, "photos": found.photos},
        found.steps,
        found.gaussians,
        found.memory.total,
        found.seconds,
    )
