"""Pages that stand alone: tables, pictures and text in one HTML file, without scripts or network.

A Table is also text, for the terminal.
"""

import base64
import io
from dataclasses import dataclass
from html import escape

import matplotlib

STYLE = """
:root { color-scheme: light; }
body { margin: 2.5rem auto; max-width: 68rem; padding: 0 1.5rem; background: #fcfcfb;
  color: #1d1f21; font: 15px/1.5 system-ui, "Segoe UI", Roboto, "Helvetica Neue", sans-serif; }
h1 { font-size: 1.6rem; line-height: 1.25; margin: 0 0 .3rem; font-weight: 650; }
h2 { font-size: 1.12rem; margin: 2.4rem 0 .6rem; font-weight: 650; }
p { margin: .3rem 0; max-width: 48rem; }
.lead, .note { color: #5c6166; }
.note { font-size: .87rem; }
.warning { background: #fff4dc; border-left: 3px solid #d98e04; padding: .45rem .8rem;
  max-width: 62rem; }
.scroll { overflow-x: auto; margin: .5rem 0; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; }
th, td { padding: .32rem 1.1rem .32rem 0; text-align: left; vertical-align: top; }
th { font-weight: 600; font-size: .85rem; color: #5c6166; border-bottom: 1px solid #b9bdc1;
  vertical-align: bottom; }
td { border-bottom: 1px solid #e6e7e8; overflow-wrap: anywhere; min-width: 2.5rem; }
.number { text-align: right; white-space: nowrap; overflow-wrap: normal; }
td:first-child { white-space: nowrap; }
th:last-child, td:last-child { padding-right: 0; }
img { display: block; width: 100%; margin: .6rem 0; }
summary { cursor: pointer; margin-top: 2.4rem; font-size: 1.12rem; font-weight: 650; }
"""


@dataclass(frozen=True)
class Table:
    """head: column titles; rows: cells as text; numbers: the columns that are aligned at the right;
    notes: what a reader must know of the cells."""

    title: str
    head: tuple
    rows: list
    numbers: tuple = ()
    notes: tuple = ()

    def html(self):
        def row(cells, tag):
            return "<tr>" + "".join(
                f"<{tag}{' class=number' if column in self.numbers else ''}>{escape(cell)}</{tag}>"
                for column, cell in enumerate(cells)) + "</tr>"
        body = "\n".join(row(cells, "td") for cells in self.rows)
        notes = "".join(f"<p class=note>{escape(note)}</p>\n" for note in self.notes)
        title = f"<h2>{escape(self.title)}</h2>\n" if self.title else ""
        return (f"{title}<div class=scroll><table>\n<thead>{row(self.head, 'th')}</thead>\n"
                f"<tbody>{body}</tbody>\n</table></div>\n{notes}")

    def text(self):
        lines = [self.head, *self.rows]
        widths = [max(len(line[column]) for line in lines) for column in range(len(self.head))]
        aligned = ["  ".join(cell.rjust(width) if column in self.numbers else cell.ljust(width)
                             for column, (cell, width) in enumerate(zip(line, widths))).rstrip()
                   for line in lines]
        return "\n".join([self.title, *aligned, *self.notes])


def embedded(path, what):
    """HTML of a PNG file, held in the page; `what` describes it to who cannot see."""
    data = base64.b64encode(path.read_bytes()).decode()
    return f'<img alt="{escape(what)}" src="data:image/png;base64,{data}">'


def picture(figure, what):
    """HTML of a matplotlib Figure, drawn into the page; `what` describes it to who cannot see."""
    svg = io.BytesIO()
    with matplotlib.rc_context({"svg.hashsalt": "clsplat"}):  # equal figures, equal bytes
        figure.savefig(svg, format="svg", facecolor="none", metadata={"Date": None})
    data = base64.b64encode(svg.getvalue()).decode()
    return f'<img alt="{escape(what)}" src="data:image/svg+xml;base64,{data}">\n'


def warning(text):
    return f"<p class=warning>{escape(text)}</p>\n"


def folded(title, html):
    """HTML that opens at a click."""
    return f"<details><summary>{escape(title)}</summary>\n{html}</details>\n"


def page(title, lead, *parts):
    """The whole page: title and lead as text, parts as HTML."""
    return (f'<!doctype html>\n<html lang="en">\n<head><meta charset="utf-8">\n'
            f'<meta name="viewport" content="width=device-width, initial-scale=1">\n'
            f"<title>{escape(title)}</title>\n<style>{STYLE}</style></head>\n<body>\n"
            f"<h1>{escape(title)}</h1>\n<p class=lead>{escape(lead)}</p>\n"
            f"{''.join(parts)}</body>\n</html>\n")
