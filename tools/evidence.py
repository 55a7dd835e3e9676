"""Make the pages of docs/evidence/ from the results of the studies.

    python -m tools.evidence

The results are JSON lines, a file of tools/studies/results/ a page. Its first line has the `page`'s
title; a line with `table` opens a table and says when, where and by which command it was measured,
and the lines up to the next one are its rows: column -> a number, a text or a list of numbers.
`defaults.jsonl` has a line for each default that was chosen by a measurement.
"""

import json
import re
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
RESULTS, PAGES = ROOT / "tools" / "studies" / "results", ROOT / "docs" / "evidence"
NOTEBOOK = "018822d"  # the commit whose docs/notebook/ the lines without a study were taken from
STUDIES = "131fdb8"  # the last commit that has the studies which are named in INDEX
NOTE = "Made by `python -m tools.evidence` from `tools/studies/results/{}`; do not edit."
INDEX = f"""# Evidence

What was measured: each default that a measurement chose, and a table for each subject.
{NOTE.format("*.jsonl")}

A line names the day, the commit and the command. The commit is that of the code that was measured,
or the first one whose notes have the figure. The notes themselves, 60,000 words with what was tried
and not kept, are in the history: `git show {NOTEBOOK}:docs/notebook/results.md`, and `judge`,
`dense`, `exposure`, `robust`, `poses`, `city`, `cities`, `exchange`, `plan`, `leave_out`,
`numerics` and `speed`. Photo sets are not part of the repository; `SET.npz` is a file of
`clsplat pack` of these days. Commands of earlier commits may have flags that are keys of the file
of `--config` today.

The studies `levels_of_detail` and `disagreeing` have answered their question and are
no longer in the tree: `git show {STUDIES}:tools/studies/NAME.py`.
"""


def records(path):
    """The JSON lines of a file."""
    return [json.loads(line) for line in path.read_text("utf-8").splitlines()]


def text_of(value, digits=0):
    """A cell of a table, whose numbers have so many digits behind the point."""
    if isinstance(value, list):
        return " / ".join(text_of(one, digits) for one in value) or "auto"
    if isinstance(value, bool):
        return "on" if value else "off"
    if isinstance(value, int):
        return f"{value:,}"
    if isinstance(value, float):
        return f"{value:.{digits}f}" if abs(value) >= 1e-3 else f"{value:g}"
    return "" if value is None else str(value).replace("|", "/")


def shown(default):
    """The default of an option, of which each number has its own digits."""
    return f"{default:g}" if isinstance(default, float) else default


def digits_of(values):
    """How many digits behind the point the numbers of a column need."""
    numbers = [
        one
        for value in values
        for one in (value if isinstance(value, list) else [value])
        if isinstance(one, float) and abs(one) >= 1e-3
    ]
    return max((len(f"{number:g}".partition(".")[2]) for number in numbers), default=0)


def table(rows):
    """Rows, column -> value, as a table of Markdown; the columns are those of the first row."""
    columns = {name: [row[name] for row in rows] for name in rows[0]}
    marks = ["---:" if any(isinstance(value, float) for value in values) else "---" for values in columns.values()]
    cells = [[text_of(value, digits_of(values)) for value in values] for values in columns.values()]
    return "\n".join(f"| {' | '.join(line)} |" for line in [columns, marks, *zip(*cells)])


def code(command):
    """A command as code; what else stands in its place remains text."""
    return f"`{command}`" if re.match(r"(clsplat|python) ", command) else command


def measured(facts):
    """The sentence that says when, where and how a table was measured."""
    where = f"{facts['device']}, " if facts.get("device") else ""
    return f"{facts['date']}, {where}commit {facts['commit']}: {code(facts['command'])}"


def page(path):
    """The Markdown of a file of results."""
    (head, *lines), parts = records(path), []
    for line in lines:
        parts.append([line]) if "table" in line else parts[-1].append(line)
    text = [f"# {head['page']}", head["about"], NOTE.format(path.name)]
    for facts, *rows in parts:
        text += [f"## {facts['table']}", facts.get("text", ""), table(rows), measured(facts)]
    return "\n\n".join(filter(None, text)) + "\n"


def index():
    """The Markdown of the first page: the defaults, and the other pages."""
    rows = [
        {
            "option": f"`{line['option'].replace('_', '-')}`",
            "default": shown(line["value"]),
            "evidence": f"[{line['evidence']}]({line['see']})",
            "date": line["date"],
            "commit": line["commit"],
            "command": code(line["command"]),
        }
        for line in records(RESULTS / "defaults.jsonl")
    ]
    links = [
        f"- [{records(path)[0]['page']}]({path.stem}.md): "
        + ", ".join(line["table"].lower() for line in records(path) if "table" in line)
        for path in files()
    ]
    return "\n".join([INDEX, *links, "", "## Defaults", "", table(rows), ""])


def files():
    """The files of results that become pages of their own."""
    return [path for path in sorted(RESULTS.glob("*.jsonl")) if path.stem != "defaults"]


def pages():
    """Path -> Markdown of all pages."""
    return {PAGES / "index.md": index(), **{PAGES / f"{path.stem}.md": page(path) for path in files()}}


if __name__ == "__main__":
    PAGES.mkdir(exist_ok=True)
    for place, markdown in pages().items():
        place.write_text(markdown, "utf-8")
