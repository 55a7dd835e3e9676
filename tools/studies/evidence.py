"""The arguments and the tables of the studies."""

import re
import sys
from pathlib import Path

import numpy as np

from clsplat.cli.main import verdict
from clsplat.errors import InputError


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
        self.name = Path(self.path).resolve().name.removesuffix(".npz")
        if self.downscale != 1:
            self.name += f"-r{number}"


def flags_after(argv):
    """The words of a command before --, and those after it, flags of `clsplat train`."""
    cut = argv.index("--") if "--" in argv else len(argv)
    return argv[:cut], argv[cut + 1:]


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


def refuse(failed):
    """Raise InputError if runs failed; called after everything else is written."""
    if failed:
        raise InputError(f"{', '.join(map(str, failed))}: failed for the reasons above; the same "
                         "command tries them again")


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
