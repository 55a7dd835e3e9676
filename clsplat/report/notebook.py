"""HTML for notebooks: a table of facts, a run with its curve and scores, a view, a scene, a model."""

import tempfile
from dataclasses import replace
from html import escape
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from clsplat.edit.select import alive, selected
from clsplat.errors import ClsplatError
from clsplat.evaluation.run import Run
from clsplat.evaluation.survey import survey_of
from clsplat.gaussians import Gaussians
from clsplat.io.models.values import opacities
from clsplat.io.photos.views import read_photo
from clsplat.placement.first_view import view_from_above
from clsplat.report.charts import drawn, score_chart
from clsplat.report.model_page import write_page
from clsplat.report.page import as_utf8, html_of, page
from clsplat.report.run import jpeg, lead
from clsplat.report.scores import score_table
from clsplat.report.survey import survey_maps
from clsplat.scene import NEAR_SHARE, Scene, View

THUMBNAIL, SMALL = 320, 160  # pixels, the longer side of the photo of a view, and in a sheet
SHEET = 12  # photos of a scene at most
MOST_SHOWN = 100_000  # gaussians: a notebook stores 2 MB for them
STEEPNESS = -0.7  # of the first view: 45 degrees
USUAL_UPS = np.array([[0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])  # georeferenced and others, by COLMAP


def table(rows: dict[str, str]) -> str:
    """An HTML table with two columns."""
    return (
        "<table>"
        + "".join(f"<tr><th>{escape(key)}</th><td>{escape(value)}</td></tr>" for key, value in rows.items())
        + "</table>"
    )


def run_page(run: Run) -> str:
    """A run as HTML, without head and body."""
    records = run.metrics
    title = "PSNR and SSIM over training time"
    curves = drawn(title, score_chart, records)
    return html_of(
        f"<p>{escape(lead(run.record, records))}</p>", curves and _framed(page(title, "", curves)), score_table(records)
    )


def _framed(page: str) -> str:
    """A whole page in a frame."""
    return (
        f'<iframe srcdoc="{escape(page)}" sandbox="allow-scripts" loading="lazy" '
        'style="width: 100%; height: 480px; border: 0"></iframe>\n'
    )


def view_card(view: View) -> str:
    """A view as HTML: its photo, its name and its camera."""
    camera = view.camera
    return _card(view, THUMBNAIL, f"<br>{camera.width} x {camera.height}, focal length {camera.focal[0]:.4g} pixels")


def _card(view: View, size: int, more: str = "") -> str:
    """A photo of at most `size` pixels a side with its name."""
    try:
        shown = jpeg(read_photo(replace(view, camera=view.camera.reduced(1.0, size))), escape(view.name))
    except (ClsplatError, OSError) as error:  # without its photo, the rest is still seen
        shown = f"<em>{escape(str(error))}</em>"
    return as_utf8(
        f'<figure style="display: inline-block; margin: 0 8px 8px 0; width: {size}px; '
        'vertical-align: top; overflow-wrap: anywhere">'
        f"{shown}<figcaption>{escape(view.name)}{more}</figcaption></figure>"
    )


def scene_page(scene: Scene) -> str:
    """A scene as HTML: facts, a map of its cameras, and some of its photos."""
    sizes = {(view.camera.width, view.camera.height) for view in scene.views}
    size = " and ".join(f"{width} x {height}" for width, height in sorted(sizes)[:3])
    facts = (
        table(
            {
                "scene": scene.name,
                "views": f"{len(scene.views)}, {size} pixels",
                "points": f"{len(scene.points):,}",
                "extent": f"{scene.extent:.4g} world units" if len(scene.points) else "unknown",
            }
        )
        if scene.views
        else ""
    )
    cameras = survey_maps(survey_of(scene)) if scene.views else ""
    chosen = scene.views[:: -(-len(scene.views) // SHEET) or 1]
    return html_of(facts, cameras, "".join(_card(view, SMALL) for view in chosen))


def model_frame(gaussians: Gaussians) -> str:
    """The page of a model in a frame, which shows a smaller model if there are many gaussians."""
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
        write_page(path, shown.located(np.zeros(3)), view, up, near=NEAR_SHARE * size, title="model")
        frame = _framed(path.read_text("utf-8"))
    few = f"; {shown.count:,} are shown here" if shown.count < visible.count else ""
    return f"{frame}<p>{gaussians.count:,} gaussians, SH degree {gaussians.sh_degree}{few}</p>"


def smaller(gaussians: Gaussians) -> Gaussians:
    """The model, without its faintest and smallest gaussians if it has more than MOST_SHOWN."""
    if gaussians.count <= MOST_SHOWN:
        return gaussians
    widest = np.sort(gaussians.log_scales, axis=1)[:, 1:].sum(axis=1)
    mass = np.log(np.maximum(opacities(gaussians), 1e-9)) + widest
    return selected(gaussians, np.sort(np.argpartition(-mass, MOST_SHOWN)[:MOST_SHOWN]))


def likely_up(points: NDArray[np.float64]) -> NDArray[np.float64]:
    """The direction float64[3] that probably points up in a model of places float64[N, 3] alone:
    of the usual ones that along which it is thinner."""
    up: NDArray[np.float64] = USUAL_UPS[np.argmin((points @ USUAL_UPS.T).std(axis=0))]
    return up
