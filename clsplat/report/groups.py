"""Groups of runs that differ only by seed, and whether comparing the groups is fair."""

import json
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from clsplat.config.option import options_of
from clsplat.errors import InputError
from clsplat.evaluation.run import Run
from clsplat.io.runs.run import find_runs
from clsplat.options import TrainOptions, serves
from clsplat.report.page import scene_name
from clsplat.report.scores import Record

FACTS = ("fingerprint", "opencl_device", "kernel_form", "version", "commit")
# without the seed, by which runs of a group differ, and `form`, whose result is kernel_form
OPTIONS = {
    option.name: option
    for option in options_of(TrainOptions)
    if option.metadata["affects"] == "model" and option.name not in ("seed", "form")
}
KEYS = (*sorted(OPTIONS, key=lambda name: name != "schedule"), *FACTS)
TITLES = {"fingerprint": "scene", "opencl_device": "OpenCL device"}
UNFAIR = {  # what it means if runs differ in these keys
    "The runs have different scenes, so no score says which is better": ("fingerprint",),
    "The runs are scored on different photos or sizes, so scores cannot be compared": (
        "test_every",
        "test_offset",
        "downscale",
        "max_resolution",
    ),
    "The runs used different devices: scores can be compared, times cannot": ("opencl_device", "kernel_form"),
    "The runs were made by different versions of clsplat": ("version", "commit"),
}


@dataclass(frozen=True)
class Trained:
    """A run as it was read.

    Attributes
    ----------
    name : its folder, relative to the common folder of all runs.
    options : options.json.
    records : metrics.jsonl.
    """

    name: str
    options: dict[str, Any]
    records: list[Record]
    finished: bool

    def uses(self, key: str) -> bool:
        """Whether the run's schedule uses one of KEYS."""
        if key not in OPTIONS:
            return True
        try:
            return serves(OPTIONS[key], str(self.options.get("schedule")))
        except InputError:  # a schedule of a package that is not installed
            return OPTIONS[key].metadata["part"] is None

    def plain(self, key: str) -> str | None:
        """The value of one of KEYS as JSON; None if the run does not use it."""
        return json.dumps(self.options.get(key), sort_keys=True) if self.uses(key) else None

    def text(self, key: str) -> str:
        """The run's value of one of KEYS, for people."""
        value = self.options.get(key)
        if key == "fingerprint":
            return f"{scene_name(self.options)} ({(value or '?')[:8]})"
        if not self.uses(key):
            return "-"
        if value is None:
            return "not recorded"
        return (value or "none") if isinstance(value, str) else json.dumps(value)


def read_runs(paths: Iterable[str | Path]) -> tuple[list[Trained], Path, list[str]]:
    """All runs in some folders, the common folder, and the names of runs without metrics."""
    paths = [Path(path).resolve() for path in paths]
    parent = Path(os.path.commonpath(paths))
    runs = {folder.path: Run(folder) for path in paths for folder in find_runs(path)}
    read, empty = [], []
    for path, run in runs.items():
        name = path.name if path == parent else path.relative_to(parent).as_posix()
        if metrics := run.metrics:
            read.append(Trained(name, run.record, metrics, run.folder.has_model))
        else:
            empty.append(name)
    if not read:
        raise InputError(f"{parent}: none of the runs has metrics yet; train them first")
    return read, parent, empty


def differing(runs: Sequence[Trained]) -> list[str]:
    """Those of KEYS in which the runs differ that use them."""
    return [key for key in KEYS if len({run.plain(key) for run in runs if run.uses(key)}) > 1]


def equal(runs: Sequence[Trained]) -> list[str]:
    """Those of KEYS that all runs use, and in which they are equal."""
    different = differing(runs)
    return [key for key in KEYS if key not in different and all(run.uses(key) for run in runs)]


def grouped(runs: Iterable[Trained]) -> dict[str, list[Trained]]:
    """Groups of runs that differ at most in their seed, by name, in the order of the runs.

    Each group is in the order of seeds. Its name has only what distinguishes it from the others.
    """
    by_values: dict[tuple[str | None, ...], list[Trained]] = {}
    for run in runs:
        by_values.setdefault(tuple(map(run.plain, KEYS)), []).append(run)
    groups = [sorted(group, key=lambda run: (run.options.get("seed") or 0, run.name)) for group in by_values.values()]
    firsts = [group[0] for group in groups]
    names: list[tuple[str, ...]] = [()] * len(firsts)
    for key in differing(firsts):
        longer = [(*name, _name_part(run, key)) for name, run in zip(names, firsts)]
        if len(set(longer)) > len(set(names)):
            names = longer
    alone = firsts[0].text("schedule")
    return {", ".join(name) or alone: group for name, group in zip(names, groups)}


def _name_part(run: Trained, key: str) -> str:
    text = run.text(key)
    if key == "commit":
        text = text[:8] + ("-dirty" if text.endswith("-dirty") else "")
    return text if key in ("schedule", "opencl_device", "fingerprint") else f"{title(key)} {text}"


def warnings(groups: Mapping[str, Sequence[Trained]]) -> list[str]:
    """Sentences on what makes the comparison of groups unfair or uncertain."""
    runs = [run for group in groups.values() for run in group]
    different = differing(runs)
    sentences = [
        f"{meaning} ({title(key)}: {' / '.join(sorted({run.text(key) for run in runs}))})."
        for meaning, keys in UNFAIR.items()
        for key in keys
        if key in different
    ]
    if unfinished := [run.name for run in runs if not run.finished]:
        sentences.append(f"Not finished yet: {', '.join(unfinished)}.")
    if len({tuple(run.options.get("seed") for run in group) for group in groups.values()}) > 1:
        sentences.append("The groups have different seeds: part of what differs between them may be chance.")
    return sentences


def title(key: str) -> str:
    """The name of one of KEYS in a table."""
    return TITLES.get(key, key.replace("_", " "))
