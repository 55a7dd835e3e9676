"""What notebooks show: a table of facts; a run as a sentence, its curve and its scores."""

from __future__ import annotations

from html import escape
from typing import TYPE_CHECKING

from clsplat.report.drawing import drawn
from clsplat.report.figures import score_figure
from clsplat.report.run import lead, score_table

if TYPE_CHECKING:
    from clsplat.evaluation.run import Run


def table(rows: dict[str, str]) -> str:
    """An HTML table of two columns."""
    return "<table>" + "".join(
        f"<tr><th>{escape(key)}</th><td>{escape(value)}</td></tr>" for key, value in rows.items()
    ) + "</table>"


def run_page(run: Run) -> str:
    """HTML without head and body."""
    options, records = run.record, run.metrics
    scores = score_table(records)
    parts = (f"<p>{escape(lead(options, records))}</p>",
             drawn("PSNR and SSIM over training time", score_figure, records),
             scores and scores.html())
    return "".join(filter(None, parts))
