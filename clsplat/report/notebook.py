"""HTML for notebooks: a table of facts, a run with its curve and scores, a view, a scene."""

from __future__ import annotations

from dataclasses import replace
from html import escape
from typing import TYPE_CHECKING

from clsplat.errors import ClsplatError
from clsplat.evaluation.survey import survey_of
from clsplat.io.photos.views import read_photo
from clsplat.report.drawing import drawn
from clsplat.report.figures import score_figure
from clsplat.report.page import as_utf8, html_of
from clsplat.report.pictures import jpeg
from clsplat.report.run import lead
from clsplat.report.scores import score_table
from clsplat.report.survey import survey_figure
from clsplat.scene import Scene, View

if TYPE_CHECKING:
    from clsplat.evaluation.run import Run

THUMBNAIL, SMALL = 320, 160  # pixels, the longer side of the photo of a view, and in a sheet
SHEET = 12  # photos of a scene at most


def table(rows: dict[str, str]) -> str:
    """An HTML table with two columns."""
    return "<table>" + "".join(
        f"<tr><th>{escape(key)}</th><td>{escape(value)}</td></tr>" for key, value in rows.items()
    ) + "</table>"


def run_page(run: Run) -> str:
    """A run as HTML, without head and body."""
    options, records = run.record, run.metrics
    return html_of(f"<p>{escape(lead(options, records))}</p>",
                   drawn("PSNR and SSIM over training time", score_figure, records),
                   score_table(records))


def view_card(view: View) -> str:
    """A view as HTML: its photo, its name and its camera."""
    camera = view.camera
    return _card(view, THUMBNAIL, f"<br>{camera.width} x {camera.height}, focal length "
                                  f"{camera.focal[0]:.4g} pixels")


def _card(view: View, size: int, more: str = "") -> str:
    """A photo of at most `size` pixels a side with its name."""
    try:
        shown = jpeg(read_photo(replace(view, camera=view.camera.reduced(1.0, size))),
                     escape(view.name))
    except (ClsplatError, OSError) as error:  # without its photo, the rest is still seen
        shown = f"<em>{escape(str(error))}</em>"
    return as_utf8(f'<figure style="display: inline-block; margin: 0 8px 8px 0; width: {size}px; '
                   'vertical-align: top; overflow-wrap: anywhere">'
                   f"{shown}<figcaption>{escape(view.name)}{more}</figcaption></figure>")


def scene_page(scene: Scene) -> str:
    """A scene as HTML: facts, a map of its cameras, and some of its photos."""
    sizes = {(view.camera.width, view.camera.height) for view in scene.views}
    size = " and ".join(f"{width} x {height}" for width, height in sorted(sizes)[:3])
    facts = table({"scene": scene.name, "views": f"{len(scene.views)}, {size} pixels",
                   "points": f"{len(scene.points):,}",
                   "extent": f"{scene.extent:.4g} world units" if len(scene.points) else "unknown"}
                  ) if scene.views else ""
    cameras = drawn("Map of the cameras", survey_figure, survey_of(scene)) if scene.views else ""
    chosen = scene.views[::-(-len(scene.views) // SHEET) or 1]
    return html_of(facts, cameras, "".join(_card(view, SMALL) for view in chosen))
