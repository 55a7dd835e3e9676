"""The model as a level leaves it: what clsplat/city/lod.py draws far away."""

from clsplat.training.finish import comments
from clsplat.training.frequency import VARIANTS, scene_frequency


def save_snapshot(training):
    """Write the model of a `loop.Training`, whose level has ended, into its run's folder.

    Outside of training time. The header tells the level's factor, the steps taken and the scene
    frequencies, in 1 / world unit.
    """
    training.pause()
    model, unit = training.step.model, training.scene.unit
    frequency = scene_frequency(training.device, model.rows, unit)
    training.run.save_snapshot(
        training.level, model.download().scaled(unit), training.scene.offset,
        (*comments(training), f"level {training.level:g}",
         *(f"frequency {name} {frequency[f'{name}_mean']:.9g}" for name in VARIANTS)))
    training.unpause()
