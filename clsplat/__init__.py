"""clsplat: large-scale 3D Gaussian-splat training on any OpenCL device.

The names below are the public Python API; whatever else lies in the package may change. They are
imported when they are first asked for, so that `clsplat --help` need not wait for a device.
"""

from importlib import import_module

TYPE_CHECKING = False  # type checkers take it for true; `typing` would take a while to import
if TYPE_CHECKING:
    from clsplat.api.city import city
    from clsplat.api.device import Device
    from clsplat.api.gaussians import Gaussians
    from clsplat.api.options import TrainOptions
    from clsplat.api.plan import Forecast, plan
    from clsplat.api.renderer import Frame, Renderer, render
    from clsplat.api.run import Run
    from clsplat.api.scene import Scene, View
    from clsplat.api.score import Score, evaluate
    from clsplat.api.trainer import Trainer, TrainingStep, train
    from clsplat.camera import Camera
    from clsplat.config.option import option
    from clsplat.errors import ClsplatError, StopTraining
    from clsplat.georeference import Georeference
    from clsplat.schedule.plan import Plan, Schedule
    from clsplat.training.part import Part

__version__ = "0.1.0"

_HOMES = {
    "Camera": "clsplat.camera",
    "ClsplatError": "clsplat.errors",
    "Device": "clsplat.api.device",
    "Forecast": "clsplat.api.plan",
    "Frame": "clsplat.api.renderer",
    "Gaussians": "clsplat.api.gaussians",
    "Georeference": "clsplat.georeference",
    "Part": "clsplat.training.part",
    "Plan": "clsplat.schedule.plan",
    "Renderer": "clsplat.api.renderer",
    "Run": "clsplat.api.run",
    "Scene": "clsplat.api.scene",
    "Schedule": "clsplat.schedule.plan",
    "Score": "clsplat.api.score",
    "StopTraining": "clsplat.errors",
    "TrainOptions": "clsplat.api.options",
    "Trainer": "clsplat.api.trainer",
    "TrainingStep": "clsplat.api.trainer",
    "View": "clsplat.api.scene",
    "city": "clsplat.api.city",
    "evaluate": "clsplat.api.score",
    "option": "clsplat.config.option",
    "plan": "clsplat.api.plan",
    "render": "clsplat.api.renderer",
    "train": "clsplat.api.trainer",
}

__all__ = [
    "Camera",
    "ClsplatError",
    "Device",
    "Forecast",
    "Frame",
    "Gaussians",
    "Georeference",
    "Part",
    "Plan",
    "Renderer",
    "Run",
    "Scene",
    "Schedule",
    "Score",
    "StopTraining",
    "TrainOptions",
    "Trainer",
    "TrainingStep",
    "View",
    "city",
    "evaluate",
    "option",
    "plan",
    "render",
    "train",
]


def __getattr__(name: str) -> object:
    if name not in _HOMES:
        raise AttributeError(f"module 'clsplat' has no attribute {name!r}")
    return getattr(import_module(_HOMES[name]), name)


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
