"""Pages that stand alone: tables, pictures and text in one HTML file, without scripts or network.

A Table is also text, for the terminal.
"""

import base64
import textwrap
from dataclasses import dataclass
from html import escape

from clsplat.report.style import STYLE

NOTES_WIDTH = 100  # characters, of notes in the terminal


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
        # words in two columns need no table where there is no room for one
        kind = " class=pairs" if len(self.head) == 2 and not self.numbers else ""
        return (f"{title}<div class=scroll><table{kind}>\n<thead>{row(self.head, 'th')}</thead>\n"
                f"<tbody>{body}</tbody>\n</table></div>\n{notes}")

    def text(self):
        lines = [self.head, *self.rows]
        widths = [max(len(line[column]) for line in lines) for column in range(len(self.head))]
        aligned = ["  ".join(cell.rjust(width) if column in self.numbers else cell.ljust(width)
                             for column, (cell, width) in enumerate(zip(line, widths))).rstrip()
                   for line in lines]
        notes = (textwrap.fill(note, NOTES_WIDTH) for note in self.notes)
        return "\n".join([self.title, *aligned, *notes])


def embedded(path, what):
    """HTML of a PNG file, held in the page; `what` describes it to who cannot see. On a telephone
    it scrolls, so that its text can be read."""
    data = base64.b64encode(path.read_bytes()).decode()
    return (f'<div class=scroll><img alt="{escape(what)}" src="data:image/png;base64,{data}">'
            "</div>\n")


def warning(text):
    return f"<p class=warning>{escape(text)}</p>\n"


def folded(title, html):
    """HTML that opens at a click."""
    return f"<details><summary>{escape(title)}</summary>\n{html}</details>\n"


def headed(heading, *parts):
    """HTML of those parts, Tables or HTML, that are there below a heading; "" where none is."""
    html = "".join(map(html_of, filter(None, parts)))
    return f"<h2>{escape(heading)}</h2>\n{html}" if html else ""


def html_of(part):
    """HTML of a Table, or of what is HTML already."""
    return part if isinstance(part, str) else part.html()


def page(title, lead, *parts):
    """The whole page: title and lead as text, parts as HTML.

    What UTF-8 cannot hold, such as the name of a file that is no text, is written as \\udcff.
    """
    text = (f'<!doctype html>\n<html lang="en">\n<head><meta charset="utf-8">\n'
            f'<meta name="viewport" content="width=device-width, initial-scale=1">\n'
            f"<title>{escape(title)}</title>\n<style>{STYLE}</style></head>\n<body>\n"
            f"<h1>{escape(title)}</h1>\n<p class=lead>{escape(lead)}</p>\n"
            f"{''.join(parts)}</body>\n</html>\n")
    return as_utf8(text)


def as_utf8(text):
    """Text with what UTF-8 cannot hold written out."""
    return text.encode("utf-8", "backslashreplace").decode()
