"""Pages that stand alone: tables, pictures, charts and text in one HTML file, without network.

A Table is also text, for the terminal.
"""

import base64
import json
import textwrap
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from importlib.resources import files
from pathlib import Path
from typing import Any

NOTES_WIDTH = 100  # characters, of notes in the terminal


@dataclass(frozen=True)
class Table:
    """A table with cells of text, for a page or the terminal.

    Attributes
    ----------
    numbers : indices of the columns that are aligned at the right.
    notes : what a reader must know about the cells.
    """

    title: str
    head: Sequence[str]
    rows: Sequence[Sequence[str]]
    numbers: Collection[int] = ()
    notes: Sequence[str] = ()

    def html(self) -> str:
        """The table for a page."""

        def row(cells: Sequence[str], tag: str) -> str:
            return (
                "<tr>"
                + "".join(
                    f"<{tag}{' class=number' if column in self.numbers else ''}>{escape(cell)}</{tag}>"
                    for column, cell in enumerate(cells)
                )
                + "</tr>"
            )

        body = "\n".join(row(cells, "td") for cells in self.rows)
        notes = "".join(f"<p class=note>{escape(note)}</p>\n" for note in self.notes)
        title = f"<h2>{escape(self.title)}</h2>\n" if self.title else ""
        # on a narrow screen, two columns of words are shown as paragraphs
        kind = " class=pairs" if len(self.head) == 2 and not self.numbers else ""
        return (
            f"{title}<div class=scroll><table{kind}>\n<thead>{row(self.head, 'th')}</thead>\n"
            f"<tbody>{body}</tbody>\n</table></div>\n{notes}"
        )

    def text(self) -> str:
        """The table for the terminal."""
        lines = [self.head, *self.rows]
        widths = [max(len(line[column]) for line in lines) for column in range(len(self.head))]
        aligned = [
            "  ".join(
                cell.rjust(width) if column in self.numbers else cell.ljust(width)
                for column, (cell, width) in enumerate(zip(line, widths))
            ).rstrip()
            for line in lines
        ]
        notes = (textwrap.fill(note, NOTES_WIDTH) for note in self.notes)
        return "\n".join([self.title, *aligned, *notes])


def embedded(path: Path, description: str) -> str:
    """HTML with a PNG file in it, which scrolls on a telephone so that its text can be read.

    Parameters
    ----------
    description : the text for readers who cannot see the picture.
    """
    data = base64.b64encode(path.read_bytes()).decode()
    return f'<div class=scroll><img alt="{escape(description)}" src="data:image/png;base64,{data}"></div>\n'


def warning(text: str) -> str:
    """HTML of a sentence that the reader must not miss."""
    return f"<p class=warning>{escape(text)}</p>\n"


def folded(title: str, html: str) -> str:
    """HTML that opens at a click."""
    return f"<details><summary>{escape(title)}</summary>\n{html}</details>\n"


def headed(heading: str, *parts: Table | str | None) -> str:
    """HTML of a heading and the parts that are not empty; "" if all are."""
    html = html_of(*parts)
    return f"<h2>{escape(heading)}</h2>\n{html}" if html else ""


def html_of(*parts: Table | str | None) -> str:
    """HTML of Tables, and of parts that are HTML already; empty parts are left out."""
    return "".join(part if isinstance(part, str) else part.html() for part in parts if part)


def page(title: str, lead: str, *parts: str, made: Mapping[str, Any] | None = None) -> str:
    """The whole page.

    Characters that UTF-8 cannot encode, as in the name of a file, are written as \\udcff.

    Parameters
    ----------
    title, lead : text of its head.
    parts : HTML; what draws its charts is added.
    made : when, by which version and by which command its content was made, see `io.origin`.
    """
    body = "".join(parts)
    if 'class="chart' in body:
        body += f"<style>{web('uplot.css')}</style>\n<script>{web('uplot.js')}\n{web('chart.js')}</script>\n"
    text = (
        f'<!doctype html>\n<html lang="en">\n<head><meta charset="utf-8">\n'
        f'<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{escape(title)}</title>\n<style>{web('report.css')}</style></head>\n<body>\n"
        f"<h1>{escape(title)}</h1>\n<p class=lead>{escape(lead)}</p>\n{_made(made or {})}"
        f"{body}</body>\n</html>\n"
    )
    return as_utf8(text)


def _made(record: Mapping[str, Any]) -> str:
    """A line with what `io.origin` has recorded; "" if that is nothing."""
    date, version, commit, command = (str(record.get(key) or "") for key in ("date", "version", "commit", "command"))
    program = f"clsplat {version}" + (f" ({commit[:8]})" if commit else "")
    facts = [
        escape(date.replace("T", " ", 1)[:16]),
        escape(program) if version else "",
        f"<code>{escape(command)}</code>" if command else "",
    ]
    line = " · ".join(filter(None, facts))
    return f"<p class=facts>{line}</p>\n" if line else ""


def script_json(value: Any) -> str:
    """JSON that may stand in an HTML script element."""
    return json.dumps(value, allow_nan=False).replace("<", "\\u003c")


def web(name: str) -> str:
    """The text of a file of web/."""
    return (files("clsplat.report") / "web" / name).read_text("utf-8")


def scene_name(options: Mapping[str, Any]) -> str:
    """The name of the scene that options.json records, without a suffix."""
    return Path(options.get("scene_absolute") or options.get("scene") or "?").stem or "?"


def full_name(run: Path, options: Mapping[str, Any]) -> str:
    """The name of a run's folder after that of its scene, since many folders are called run; alone
    if one is part of the other.

    Parameters
    ----------
    run : the folder.
    options : of its options.json.
    """
    name, scene = run.resolve().name, scene_name(options)
    return name if scene in name or name in scene or scene == "?" else f"{scene}: {name}"


def as_utf8(text: str) -> str:
    """Text in which characters that UTF-8 cannot encode are written out."""
    return text.encode("utf-8", "backslashreplace").decode()
