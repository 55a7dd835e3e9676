"""Models of runs in files for other programs, as they are or upright."""

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from clsplat.edit.transform import transformed
from clsplat.evaluation.run import Run
from clsplat.gaussians import Gaussians
from clsplat.io.models.formats import write_model
from clsplat.io.models.values import mode_comment

VIEWERS_UP = np.array([0.0, -1.0, 0.0])  # of SuperSplat and others, in the axes of a PLY


def write_run_model(path: Path, run: Run, gaussians: Gaussians, upright: bool = False) -> None:
    """Write gaussians of a run in the format of a suffix, with what the run knows about them.

    Parameters
    ----------
    path : as for `models.write_model`.
    gaussians : in original coordinates.
    upright : turn them so that up is -y.

    Raises
    ------
    InputError : it is not known what is up, or the file cannot be written.
    """
    comments = (mode_comment(run.options.antialiased),)
    if upright:
        turn, _ = Rotation.align_vectors([VIEWERS_UP], [run.up])
        turned = transformed(gaussians, rotation=turn.as_matrix())
        write_model(path, turned, comments, VIEWERS_UP)
        return
    write_model(path, gaussians, comments, run.known_up, run.georeference)
