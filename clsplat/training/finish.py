"""Writes the results of a training: models and the report."""

import logging
from typing import Any

from clsplat.errors import ClsplatError
from clsplat.evaluation.views import pictures_of
from clsplat.io.georeference.files import placement_comments
from clsplat.io.models.ply import START, start_comment
from clsplat.io.models.values import mode_comment
from clsplat.io.reason import reason
from clsplat.io.runs.run import RunFolder
from clsplat.report.run import write_report
from clsplat.scene import Scene
from clsplat.training.interrupt import was_interrupted
from clsplat.training.session import Session


def save_model(run: RunFolder, session: Session) -> None:
    """Write the finished model, and what its parts have learned."""
    session.step.settle()
    for part in session.parts:
        part.write(run, session)
    gaussians = session.model.download().scaled(session.scene.unit)
    comments = (*start_comment(str(run.read_options().get(START, ""))),
                f"iterations {session.iteration}", mode_comment(session.options.antialiased),
                *placement_comments(session.scene.up, session.scene.georeference))
    run.save_model(gaussians, session.scene.offset, comments, session.options.sphere_columns)


def draw_report(run: RunFolder, session: Session, scene: Scene,
                per_view: list[dict[str, Any]] | None) -> None:
    """Write the report of a finished training, whose `scene` is at the size of the photos, with the
    scores of the held-out views, if known. Failure is only a warning: the model is complete."""
    try:
        write_report(run, pictures=pictures_of(
            session.renderer, session.model.current_rows(), session.options.sh_degree,
            session.test_views, session.corrected(session.train_views), per_view,
            session.predicted()), scene=scene)
    except ClsplatError:
        raise
    except Exception as error:  # noqa: BLE001  (fonts, locales, matplotlib settings)
        if was_interrupted(error):
            raise
        logging.getLogger(__name__).warning(
            "%s: the report could not be drawn (%s: %s); the model is complete",
            run.path, type(error).__name__, reason(error))
