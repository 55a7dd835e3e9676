"""A model as HTML for notebooks: its page in a frame."""

import tempfile
from html import escape
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from clsplat.edit.decimate import decimated
from clsplat.edit.select import alive, selected
from clsplat.gaussians import Gaussians
from clsplat.io.models.values import opacities
from clsplat.placement.first_view import view_from_above
from clsplat.report.model_page import write_page
from clsplat.scene import NEAR_SHARE

MOST_SHOWN = 100_000  # gaussians: a notebook stores 2 MB for them
MOST_MERGED = 2 * MOST_SHOWN  # from which they are merged, which takes seconds
STEEPNESS = -0.7  # of the first view: 45 degrees
FLAT = 0.35  # of the middle axis of the positions: a thinner model lies on the ground
USUAL_UPS = np.array([[0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])  # georeferenced and others, by COLMAP


def model_frame(gaussians: Gaussians) -> str:
    """The page of a model in a frame, which shows a smaller model if there are many gaussians.

    Parameters
    ----------
    gaussians : the model.
    """
    visible = selected(gaussians, alive(gaussians))
    if not visible.count:
        return f"<p>{escape(repr(gaussians))}: nothing to show</p>"
    shown = smaller(visible)
    sizes = np.exp(shown.log_scales.max(axis=1, keepdims=True).astype(np.float64))
    points = np.concatenate([shown.positions - sizes, shown.positions + sizes])
    up = likely_up(points)
    level = np.cross(up, np.eye(3)[np.abs(up).argmin()])
    view = view_from_above(points, up, level / np.linalg.norm(level), STEEPNESS)
    size = float(np.linalg.norm(np.median(points, axis=0) - view.position))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "model.html"
        write_page(path, shown.located(np.zeros(3)), view, up, near=NEAR_SHARE * size,
                   title="model")
        page = path.read_text("utf-8")
    few = f"; {shown.count:,} are shown here, merged of their neighbours" if (
        shown.count < visible.count) else ""
    return (f'<iframe srcdoc="{escape(page)}" sandbox="allow-scripts" loading="lazy" '
            'style="width: 100%; height: 480px; border: 0"></iframe>\n'
            f"<p>{gaussians.count:,} gaussians, SH degree {gaussians.sh_degree}{few}</p>")


def smaller(gaussians: Gaussians) -> Gaussians:
    """The model if it has at most MOST_SHOWN gaussians, else one of so many that looks like it.

    Parameters
    ----------
    gaussians : of any number; before the others are merged, the faintest and smallest are left out.
    """
    if gaussians.count <= MOST_SHOWN:
        return gaussians
    if gaussians.count > MOST_MERGED:
        widest = np.sort(gaussians.log_scales, axis=1)[:, 1:].sum(axis=1)
        mass = np.log(np.maximum(opacities(gaussians), 1e-9)) + widest
        kept = np.sort(np.argpartition(-mass, MOST_MERGED)[:MOST_MERGED])
        gaussians = selected(gaussians, kept)
    return decimated(gaussians, MOST_SHOWN)


def likely_up(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """The direction float64[3] that probably points up in a model of which only places are known:
    the thin side of a flat one, else the usual direction that is nearest to it.

    Parameters
    ----------
    points : float64[N, 3], at least one.
    """
    spread, axes = np.linalg.eigh(np.cov(points.T) if len(points) > 1 else np.eye(3))
    along = USUAL_UPS @ axes[:, 0]
    usual = int(np.argmax(np.abs(along)))
    if spread[0] < FLAT**2 * spread[1] and along[usual]:
        thin: NDArray[np.float64] = axes[:, 0] * np.sign(along[usual])
        return thin
    up: NDArray[np.float64] = USUAL_UPS[usual]
    return up
