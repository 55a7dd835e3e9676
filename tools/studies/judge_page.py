"""The tables of tools/studies/judge.py.

A number of a set is the mean over its divisions of the mean over their seeds; a number of a column
is the mean over sets.
"""

import re
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from clsplat.io.atomic import replacing
from clsplat.report.page import Table
from clsplat.report.scores import reached, spread
from tools.studies.study import cell, markdown

CC, PLAIN = "psnr_cc", "psnr"
# of a result: title, key, digits
SCORES = (
    ("PSNR cc, dB", CC, 2),
    ("PSNR, dB", PLAIN, 2),
    ("SSIM cc", "ssim_cc", 4),
    ("SSIM", "ssim", 4),
    ("PSNR cc where seen, dB", "psnr_cc_seen", 2),
    ("FLIP cc", "flip_cc", 4),
    ("gaussians", "gaussians", 0),
    ("training, s", "train_seconds", 1),
)


class Division(NamedTuple):
    """What a run is trained and scored on."""

    set: str  # the name of the photo set
    steps: int
    offset: int  # `--test-offset`
    seed: int

    def __str__(self):
        return f"{self.set} {self.steps} steps, offset {self.offset}, seed {self.seed}"


@dataclass(frozen=True, eq=False)
class Result:
    """A finished run: its column, its division, and what `judge.result_of` keeps of it."""

    name: str
    division: Division
    values: dict

    @property
    def best(self):
        """The best PSNR cc of any evaluation, dB."""
        return max(point[2] for point in self.values["curve"])

    def seconds_to(self, level):
        """Training seconds until PSNR cc reaches a level, dB; None if it never does."""
        _, seconds, psnr_cc, *_ = np.array(self.values["curve"], float).T
        found = reached((seconds, psnr_cc), level)
        return found and found[0]


class Compared:
    """The results of one number of steps, on the divisions and seeds that every column has.

    Attributes
    ----------
    names : the columns, in the order of the results.
    cells : (set, offset) -> name -> results, one for each seed.
    sets : set -> its offsets.
    left_out : how many seeds of divisions a column lacks.
    """

    def __init__(self, results):
        self.names = list(dict.fromkeys(result.name for result in results))
        divisions = {}
        for result in results:
            divisions.setdefault(result.division, {})[result.name] = result
        complete = {division: by_name for division, by_name in divisions.items() if len(by_name) == len(self.names)}
        self.left_out = len(divisions) - len(complete)
        self.cells, self.sets = {}, {}
        for division, by_name in complete.items():
            runs = self.cells.setdefault((division.set, division.offset), {})
            for name, result in by_name.items():
                runs.setdefault(name, []).append(result)
        for name, offset in self.cells:
            self.sets.setdefault(name, []).append(offset)

    def of_set(self, name, measure, *, among=None):
        """Set -> the mean of a measure of one column, which may be one of two columns' runs, at
        the places `among` (set, offset), None: all. `measure` makes of the results of a division by
        column a number or None."""
        means = {}
        for place, by_name in self.cells.items():
            value = measure(by_name, name) if among is None or place in among else None
            if value is not None:
                means.setdefault(place[0], []).append(value)
        return {of: float(np.mean(values)) for of, values in means.items()}


def mean_of(key):
    """A measure: the mean of a score over seeds."""
    return lambda by_name, name: float(np.mean([r.values[key] for r in by_name[name]]))


def more_than(baseline, key):
    """A measure: a score minus that of the baseline."""
    own = mean_of(key)
    return lambda by_name, name: own(by_name, name) - own(by_name, baseline)


def log_ratio(baseline, key):
    """A measure: the logarithm of a score over that of the baseline."""
    own = mean_of(key)
    return lambda by_name, name: float(np.log(own(by_name, name) / own(by_name, baseline)))


def deviation(by_name, name):
    """A measure: the variance over seeds of PSNR cc; None for one seed."""
    value = spread([result.values[CC] for result in by_name[name]])[1]
    return None if value is None else value**2


def fallen(by_name, name):
    """A measure: by how much the end is below the best moment, PSNR cc."""
    return float(np.mean([result.best - result.values[CC] for result in by_name[name]]))


def time_to(baseline):
    """A measure: the logarithm of the time to the baseline's final PSNR cc over the baseline's
    whole time; None where a run does not reach it."""

    def measure(by_name, name):
        level = np.mean([result.values[CC] for result in by_name[baseline]])
        whole = np.mean([result.values["train_seconds"] for result in by_name[baseline]])
        times = [result.seconds_to(level) for result in by_name[name]]
        return None if None in times else float(np.log(np.mean(times) / whole))

    return measure


def write_page(path, baseline, chosen, flags, results, wanted):
    """Write the page, and return its tables.

    Parameters
    ----------
    path : of the Markdown file.
    baseline : the column that others are compared with.
    chosen : SET or SET:OFFSET on which choices were made.
    flags : of all runs.
    results : of the finished runs.
    wanted : how many runs the study has.
    """
    parts, made = ["# Judge", facts(results, flags, wanted), divisions(results, chosen)], []
    for steps in sorted({result.division.steps for result in results}):
        compared = Compared([r for r in results if r.division.steps == steps])
        if baseline not in compared.names or not compared.cells:
            parts.append(f"## {steps:,} steps\n\nNo division has a run of every column yet.")
            continue
        tables = (score_table(compared), baseline_table(compared, baseline, chosen), set_table(compared, baseline))
        made += [replace(table, title=f"{steps:,} steps: {table.title}") for table in tables]
        parts += [f"## {steps:,} steps", *map(markdown, tables)]
    with replacing(path) as file:
        file.write(("\n\n".join(parts) + "\n").encode())
    print(f"{path}: {len(results)} of {wanted} runs")
    return made


def facts(results, flags, wanted):
    """A paragraph on what ran where."""
    said = [f"{len(results)} of {wanted} runs"]
    for key, label in (("opencl_device", ""), ("kernel_form", "form "), ("commit", "commit ")):
        values = sorted({re.sub(r"(?<=^[0-9a-f]{8})[0-9a-f]+", "", str(result.values.get(key))) for result in results})
        said.append(label + " / ".join(values))
        if key == "opencl_device" and len(values) > 1:
            said.append("times of different devices cannot be compared")
    if flags:
        said.append(f"flags of all runs: {' '.join(flags)}")
    return f"{'; '.join(said)}."


def is_chosen(place, chosen):
    """Whether choices were made on a division (set, offset)."""
    name, offset = place
    return name in chosen or f"{name}:{offset}" in chosen


def divisions(results, chosen):
    """A paragraph on which divisions were used to choose, and which confirm."""
    places = sorted({(r.division.set, r.division.offset) for r in results})

    def listed(wanted):
        by_set = {}
        for place in places:
            if is_chosen(place, chosen) == wanted:
                by_set.setdefault(place[0], []).append(str(place[1]))
        return "; ".join(f"{name} (offsets {', '.join(offsets)})" for name, offsets in by_set.items()) or "none"

    return f"Choices were made on: {listed(True)}.\n\nThey are confirmed on: {listed(False)}."


def score_table(compared):
    """Means over sets, the spread over seeds, and the set with the worst score."""
    rows = []
    for name in compared.names:
        own = {key: compared.of_set(name, mean_of(key)) for _, key, _ in SCORES}
        variances = list(compared.of_set(name, deviation).values())
        worst = min(own[CC], key=own[CC].get)
        rows.append(
            (
                name,
                str(sum(len(by_name[name]) for by_name in compared.cells.values())),
                *(cell(np.mean(list(own[key].values())), None, digits) for _, key, digits in SCORES),
                cell(np.sqrt(np.mean(variances)) if variances else None, None, 3),
                f"{worst} {own[CC][worst]:.2f}",
            )
        )
    offsets = sum(map(len, compared.sets.values()))
    notes = [
        "cc: after a quadratic fit of each render's colours to its photo. The spread is the "
        "standard deviation of PSNR cc over seeds, its root mean square over divisions."
    ]
    if compared.left_out:
        notes.append(f"{compared.left_out} seeds of divisions are left out: a column has no run there.")
    return Table(
        f"Means over {len(compared.sets)} sets, {offsets} divisions",
        ("", "runs", *(title for title, _, _ in SCORES), "spread, dB", "worst set, PSNR cc"),
        rows,
        range(1, 11),
        notes,
    )


def baseline_table(compared, baseline, chosen):
    """Each column against the baseline."""
    own = {place for place in compared.cells if is_chosen(place, chosen)}
    others = set(compared.cells) - own
    best = {of: max(compared.of_set(name, mean_of(CC))[of] for name in compared.names) for of in compared.sets}
    rows = []
    for name in compared.names:
        more, plain = (compared.of_set(name, more_than(baseline, key)) for key in (CC, PLAIN))
        below = {of: best[of] - value for of, value in compared.of_set(name, mean_of(CC)).items()}
        ratios = [
            mean_ratio(compared.of_set(name, measure))
            for measure in (log_ratio(baseline, "gaussians"), log_ratio(baseline, "train_seconds"))
        ]
        soon = compared.of_set(name, time_to(baseline))
        lost = compared.of_set(name, fallen)
        rows.append(
            (
                name,
                with_error(more),
                *(with_error(compared.of_set(name, more_than(baseline, CC), among=places)) for places in (own, others)),
                with_error(plain),
                lowest(more),
                lowest(plain),
                highest(below),
                *ratios,
                f"{mean_ratio(soon)} ({len(soon)} of {len(compared.sets)})",
                highest(lost),
            )
        )
    return Table(
        f"Against {baseline}",
        (
            "",
            "PSNR cc more, dB",
            "where chosen",
            "where confirmed",
            "PSNR more, dB",
            "worst set, cc",
            "worst set, PSNR",
            "most below the best column of a set, cc",
            "gaussians, ratio",
            "training, ratio",
            "time to its end, ratio",
            "most below its own best moment",
        ),
        rows,
        range(1, 12),
        (
            "± is the standard error of the mean over sets. Ratios are geometric means. Time to its "
            f"end: until the PSNR cc with which {baseline} ends, over the time of {baseline}; in "
            "brackets, on how many sets a run of every seed gets there.",
        ),
    )


def set_table(compared, baseline):
    """Every set, with a row for each column."""
    rows = []
    for of in compared.sets:
        for name in compared.names:
            runs = [run for (place, _), by_name in compared.cells.items() if place == of for run in by_name[name]]
            means = [cell(compared.of_set(name, mean_of(key))[of], None, digits) for _, key, digits in SCORES]
            deviations = compared.of_set(name, deviation).get(of)
            rows.append(
                (
                    of,
                    name,
                    str(len(runs)),
                    *means,
                    cell(None if deviations is None else np.sqrt(deviations), None, 3),
                    *(cell(compared.of_set(name, more_than(baseline, key))[of], None, 2, "+") for key in (CC, PLAIN)),
                )
            )
    return Table(
        "By set",
        (
            "set",
            "",
            "runs",
            *(title for title, _, _ in SCORES),
            "spread, dB",
            f"cc to {baseline}",
            f"PSNR to {baseline}",
        ),
        rows,
        range(2, 14),
        (),
    )


def with_error(by_set):
    """The mean over sets with its standard error."""
    values = list(by_set.values())
    if not values:
        return "-"
    mean, over_sets = spread(values)
    return cell(mean, None if over_sets is None else over_sets / np.sqrt(len(values)), 2, "+")


def mean_ratio(by_set):
    """The geometric mean of ratios whose logarithms are given."""
    return cell(np.exp(np.mean(list(by_set.values()))) if by_set else None, None, 2)


def lowest(by_set):
    """The set with the lowest value."""
    name = min(by_set, key=by_set.get)
    return f"{name} {by_set[name]:+.2f}"


def highest(by_set):
    """The set with the highest value."""
    name = max(by_set, key=by_set.get)
    return f"{name} {by_set[name]:.2f}"
