"""HTML for notebooks: a table of facts, and a run with its curve and scores."""

from __future__ import annotations

from html import escape
from typing import TYPE_CHECKING

from clsplat.report.drawing import drawn
from clsplat.report.figures import score_figure
from clsplat.report.page import html_of
from clsplat.report.run import lead
from clsplat.report.scores import score_table

if TYPE_CHECKING:
    from clsplat.evaluation.run import Run


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
