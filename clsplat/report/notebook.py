"""A run as a notebook shows it: a sentence, the curve of its scores, and the last of them."""

from html import escape

from clsplat.io.run import RunFolder
from clsplat.report.drawing import drawn
from clsplat.report.figures import score_figure
from clsplat.report.run import lead, score_table


def run_page(run: RunFolder) -> str:
    """HTML without head and body."""
    options, records = run.read_options(), list(run.past_records())
    table = score_table(records)
    parts = (f"<p>{escape(lead(options, records))}</p>",
             drawn("PSNR and SSIM over training time", score_figure, records),
             table and table.html())
    return "".join(filter(None, parts))
