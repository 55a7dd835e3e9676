"""clsplat: large-scale 3D Gaussian-splat training on any OpenCL device.

The names below are the public Python API; whatever else lies in the package may change. They are
imported when they are first asked for, so that `clsplat --help` need not wait for a device.
"""

from importlib import import_module

TYPE_CHECKING = False  # type checkers take it for true; `typing` would take a while to import
if TYPE_CHECKING:
    from clsplat.api.city import city as city
    from clsplat.api.device import Device as Device
    from clsplat.api.gaussians import Gaussians as Gaussians
    from clsplat.api.options import TrainOptions as TrainOptions
    from clsplat.api.plan import Forecast as Forecast
    from clsplat.api.plan import plan as plan
    from clsplat.api.renderer import Frame as Frame
    from clsplat.api.renderer import Renderer as Renderer
    from clsplat.api.renderer import render as render
    from clsplat.api.run import Run as Run
    from clsplat.api.scene import Scene as Scene
    from clsplat.api.scene import View as View
    from clsplat.api.score import Score as Score
    from clsplat.api.score import evaluate as evaluate
    from clsplat.api.trainer import Trainer as Trainer
    from clsplat.api.trainer import TrainingStep as TrainingStep
    from clsplat.api.trainer import train as train
    from clsplat.camera import Camera as Camera
    from clsplat.config.option import option as option
    from clsplat.errors import ClsplatError as ClsplatError
    from clsplat.errors import StopTraining as StopTraining
    from clsplat.georeference import Georeference as Georeference
    from clsplat.schedule.plan import Plan as Plan
    from clsplat.schedule.plan import Schedule as Schedule
    from clsplat.training.part import Part as Part

__version__ = "0.1.0"

_HOMES = {
    "Camera": "clsplat.camera", "ClsplatError": "clsplat.errors", "Device": "clsplat.api.device",
    "Forecast": "clsplat.api.plan", "Frame": "clsplat.api.renderer",
    "Gaussians": "clsplat.api.gaussians", "Georeference": "clsplat.georeference",
    "Part": "clsplat.training.part", "Plan": "clsplat.schedule.plan",
    "Renderer": "clsplat.api.renderer", "Run": "clsplat.api.run", "Scene": "clsplat.api.scene",
    "Schedule": "clsplat.schedule.plan", "Score": "clsplat.api.score",
    "StopTraining": "clsplat.errors", "TrainOptions": "clsplat.api.options",
    "Trainer": "clsplat.api.trainer", "TrainingStep": "clsplat.api.trainer",
    "View": "clsplat.api.scene", "city": "clsplat.api.city", "evaluate": "clsplat.api.score",
    "option": "clsplat.config.option", "plan": "clsplat.api.plan",
    "render": "clsplat.api.renderer", "train": "clsplat.api.trainer"}

__all__ = ["Camera", "ClsplatError", "Device", "Forecast", "Frame", "Gaussians", "Georeference",
           "Part", "Plan", "Renderer", "Run", "Scene", "Schedule", "Score", "StopTraining",
           "TrainOptions", "Trainer", "TrainingStep", "View", "city", "evaluate", "option",
           "plan", "render", "train"]


def __getattr__(name: str) -> object:
    if name not in _HOMES:
        raise AttributeError(f"module 'clsplat' has no attribute {name!r}")
    return getattr(import_module(_HOMES[name]), name)


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
