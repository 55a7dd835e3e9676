"""What the studies share: arguments, tables, and how these become evidence."""

import json
import os
import re
import subprocess
import sys
import time
from datetime import date
from pathlib import Path

import numpy as np

from clsplat.cli.main import verdict
from clsplat.errors import InputError
from clsplat.io.runs.origin import checkout_commit

RESULTS = Path(__file__).parent / "results"


class Scene:
    """A scene's path and the downscale of its full resolution, from PATH or PATH:DOWNSCALE.

    InputError where the path does not exist.
    """

    def __init__(self, text):
        match = re.fullmatch(r"(.+):(\d+(?:\.\d+)?)", text)
        self.path, number = match.groups() if match else (text, "1")
        self.downscale = float(number)
        if not Path(self.path).exists():
            raise InputError(f"{self.path}: no such scene; check the path")
        self.name = Path(self.path).resolve().name
        if self.downscale != 1:
            self.name += f"-r{number}"


def timed_training(scene, run, flags, checkout=None):
    """Train a scene into the folder `run` by a process of its own; returns its seconds.

    `checkout` is that of clsplat, None for this one; the packages are those of this process.
    """
    root = Path(checkout or Path(__file__).parents[2]).resolve()
    paths = os.pathsep.join([str(root), os.environ.get("PYTHONPATH", "")])
    begin = time.perf_counter()
    subprocess.run(
        [sys.executable, "-m", "clsplat", "train", Path(scene).resolve(), "-o", Path(run).resolve(), "-q", *flags],
        check=True,
        cwd=Path(run).resolve().parent,
        env={**os.environ, "PYTHONPATH": paths},
    )
    return time.perf_counter() - begin


def flags_after(argv):
    """The words of a command before --, and those after it, flags of `clsplat train`."""
    cut = argv.index("--") if "--" in argv else len(argv)
    return argv[:cut], argv[cut + 1 :]


def cell(value, deviation, digits, sign=""):
    """A number with its deviation as text; None and nan are -."""
    if value is None or np.isnan(value):
        return "-"
    more = "" if deviation is None or np.isnan(deviation) else f" ± {deviation:,.{digits}f}"
    return f"{value:{sign},.{digits}f}{more}"


def markdown(table):
    """A `report.page.Table` as Markdown."""

    def row(cells):
        return f"| {' | '.join(text.replace('|', '/') for text in cells)} |"

    rule = [("---:" if column in table.numbers else "---") for column in range(len(table.head))]
    lines = [row(table.head), row(rule), *map(row, table.rows)]
    return "\n\n".join([f"### {table.title}", "\n".join(lines), *table.notes])


def keeps(parser):
    """Add the argument that makes evidence of a study's tables."""
    parser.add_argument(
        "--keep",
        metavar="PAGE",
        help="put the tables into the results of this page of the evidence, in place of those with their titles",
    )


def keep(page, tables, command, device):
    """Put measured tables into the results of a page of the evidence.

    `python -m tools.evidence` makes the page of them.

    Parameters
    ----------
    page : name of a file of tools/studies/results/, without its suffix; None: nothing is done.
    tables : those of `report.page`; they replace tables with their titles.
    command, device : how and where they were measured.
    """
    if page is None:
        return
    path = RESULTS / f"{page}.jsonl"
    head, *blocks = blocks_of(path.read_text("utf-8").splitlines())
    for table in tables:
        facts = {
            "table": table.title,
            "date": date.today().isoformat(),
            "commit": (checkout_commit() or "unknown")[:7],
            "device": device,
            "command": command,
            "source": "this command",
            "text": " ".join(table.notes),
        }
        rows = [dict(zip(table.head, row)) for row in table.rows]
        place = next(
            (number for number, block in enumerate(blocks) if json.loads(block[0])["table"] == table.title), len(blocks)
        )
        blocks[place : place + 1] = [[json.dumps(line, ensure_ascii=False) for line in (facts, *rows)]]
    path.write_text("\n".join(line for block in (head, *blocks) for line in block) + "\n", "utf-8")


def blocks_of(lines):
    """The lines of a file of results: its head, and those of each table."""
    blocks = []
    for line in lines:
        if not blocks or "table" in json.loads(line):
            blocks.append([])
        blocks[-1].append(line)
    return blocks


def refuse(failed):
    """Raise InputError if runs failed; called after everything else is written."""
    if failed:
        raise InputError(
            f"{', '.join(map(str, failed))}: failed for the reasons above; the same command tries them again"
        )


def outermost(main):
    """Run `main` with the arguments of the command; an error that the user can cure is one line."""
    try:
        main(sys.argv[1:])
    except (Exception, KeyboardInterrupt) as error:  # noqa: BLE001  (the outermost place)
        message, code = verdict(error)
        if code == 1:
            raise
        print(message, file=sys.stderr)
        sys.exit(code)
