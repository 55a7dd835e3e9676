"""The end of a training: the model that others open, and the page that people read."""

import logging

from clsplat.errors import ClsplatError
from clsplat.evaluation.views import pictures_of
from clsplat.io.reason import reason
from clsplat.report.run import write_report
from clsplat.training.interrupt import was_interrupted


def save_model(training):
    """Write the finished model of a `loop.Training`, and what was learned of its photos' colours.
    """
    if training.step.exposures:
        training.run.save_exposures(learned_exposures(training))
    gaussians = training.step.model.download().scaled(training.scene.unit)
    training.run.save_model(gaussians, training.scene.offset, comments(training),
                            training.options.sphere_columns)


def learned_exposures(training):
    """View name -> float[3, 4]."""
    rows = training.step.exposures.transforms.download().reshape(-1, 3, 4)
    return {view.name: row for view, row in zip(training.train_views, rows)}


def comments(training):
    """Lines for the PLY header that other tools read."""
    mode = "mip" if training.options.antialiased else "default"
    return (f"iterations {training.iteration}", f"SplatRenderMode: {mode}")


def draw_report(training):
    """Write the page of a run. A page that cannot be drawn is a warning: the model is complete."""
    try:
        write_report(training.run, pictures=pictures_of(
            training.renderer, training.step.model.rows, training.options.sh_degree,
            training.test_views, training.train_views, training.per_view))
    except ClsplatError:
        raise
    except Exception as error:  # noqa: BLE001  (fonts, locales, settings of matplotlib)
        if was_interrupted(error):
            raise
        logging.getLogger(__name__).warning(
            "%s: the report could not be drawn (%s: %s); the model is complete",
            training.run.path, type(error).__name__, reason(error))
