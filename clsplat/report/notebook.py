"""What notebooks show: a table of facts; a run as a sentence, its curve and its scores."""

from html import escape

from clsplat.io.run import RunFolder
from clsplat.report.drawing import drawn
from clsplat.report.figures import score_figure
from clsplat.report.run import lead, score_table


def table(rows: dict[str, str]) -> str:
    """An HTML table of two columns."""
    return "<table>" + "".join(
        f"<tr><th>{escape(key)}</th><td>{escape(value)}</td></tr>" for key, value in rows.items()
    ) + "</table>"


def run_page(run: RunFolder) -> str:
    """HTML without head and body."""
    options, records = run.read_options(), list(run.past_records())
    scores = score_table(records)
    parts = (f"<p>{escape(lead(options, records))}</p>",
             drawn("PSNR and SSIM over training time", score_figure, records),
             scores and scores.html())
    return "".join(filter(None, parts))
