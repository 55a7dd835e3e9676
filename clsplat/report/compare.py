"""Comparisons of runs: error over training time, and in which options they differ."""

import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from clsplat.io.atomic import replacing
from clsplat.io.folders import make_folder
from clsplat.io.records import write_object
from clsplat.io.runs.origin import origin
from clsplat.report import scores
from clsplat.report.charts import comparison_chart, drawn
from clsplat.report.groups import Trained, differing, equal, grouped, read_runs, title, warnings
from clsplat.report.page import Table, as_utf8, folded, page, warning

# of each run: key, title, format
SCORES = (*scores.COLUMNS[2:], *scores.PERCEPTUAL)
COSTS = scores.COLUMNS[1], scores.GAUSSIANS, ("pixel_pairs", "pairs", ".3g")
SPREAD = ("train_seconds", "psnr_cc", "ssim_cc", "flip_cc", "lpips_cc")  # shown with deviation
EQUAL = "psnr_cc_at_equal_seconds"
NO_CURVE = (
    "No curve: no run has more than one evaluation. Train with --eval-every STEPS, an "
    "eighth of -n or less, to see the error over time."
)
LEVEL_STEP = 0.5  # dB: levels chosen from the data are multiples of it
FINAL_NOTES = (
    "cc: after the colour fit. Lower is better for FLIP and LPIPS. ± is the standard deviation "
    "over the runs of a group.",
    "Pairs: of gaussian and pixel, with all pixels of the tiles that a gaussian touches; a cost of "
    "training that does not depend on the machine.",
)
TIME_NOTES = (
    "Seconds of training until the colour-corrected PSNR was reached, and the PSNR when the "
    "shortest run ended; linear between evaluations. Where only some runs of a group have a value, "
    "it is how many; ≤: a run had reached it at its first evaluation.",
)


def write_comparison(
    paths: Iterable[str | Path], folder: str | Path | None = None, levels: Sequence[float] = ()
) -> tuple[str, Path]:
    """Compare runs and write compare.html and compare.json.

    Parameters
    ----------
    paths : folders with runs.
    folder : for the files; None: the common folder of the runs.
    levels : colour-corrected PSNR, dB, whose training times to list; empty: chosen from the data.

    Returns
    -------
    The tables as text, and the path of the page.
    """
    runs, parent, empty = read_runs(paths)
    groups = grouped(runs)
    result = compare(groups, levels)
    if empty:
        result["warnings"].append(f"Left out, since they have no records yet: {', '.join(empty)}.")
    final, time = final_table(result), time_table(result)
    different, same = (
        different_table(groups),
        Table("", ("", "all runs"), [(title(key), runs[0].text(key)) for key in equal(runs)]),
    )
    folder = Path(folder or parent)
    make_folder(folder, "choose another --output")
    write_object(folder / "compare.json", result, indent=2)
    curves = drawn(
        "PSNR, SSIM and number of gaussians over training time, by group",
        comparison_chart,
        {name: [run.records for run in group] for name, group in groups.items()},
        result["levels"],
    )
    count = len(runs)
    html = page(
        f"Comparison: {', '.join(groups)}",
        f"{count} run{'s' if count > 1 else ''} of {parent.name}. Training time leaves out "
        "evaluations and checkpoints; colour-corrected scores come after a quadratic fit of each "
        "render's colours to its photo.",
        curves or f"<p class=note>{NO_CURVE}</p>\n",
        *map(warning, result["warnings"]),
        final.html(),
        time.html(),
        different.html(),
        folded("What is equal", same.html()),
        made=origin(),
    )
    written = folder / "compare.html"
    with replacing(written) as file:
        file.write(html.encode())
    # what matters most comes last: a terminal shows the end
    text = "\n\n".join(
        [
            different.text(),
            final.text(),
            time.text(),
            *([] if curves else [NO_CURVE]),
            *(f"warning: {sentence}" for sentence in result["warnings"]),
        ]
    )
    return as_utf8(text), written


def compare(groups: Mapping[str, Sequence[Trained]], levels: Sequence[float] = ()) -> dict[str, Any]:
    """The content of compare.json, from the result of `grouped`.

    Times are training seconds, interpolated linearly between evaluations.
    """
    runs = [run for group in groups.values() for run in group]
    lines = {run.name: _psnr(run) for run in runs}
    lines = {name: line for name, line in lines.items() if len(line[0])}
    levels = sorted(set(levels)) or levels_from(
        [[lines[run.name] for run in group if run.name in lines] for group in groups.values()]
    )
    shortest = min((float(x[-1]) for x, _ in lines.values()), default=None)
    different = differing(runs)
    compared = []
    for name, group in groups.items():
        rows = [_numbers(run, levels, shortest) for run in group]
        means = {
            key: scores.spread([row[key] for row in rows]) for key in (*(key for key, _, _ in (*COSTS, *SCORES)), EQUAL)
        }
        compared.append(
            {
                "name": name,
                "options": {key: group[0].options.get(key) for key in different},
                "mean": {key: mean for key, (mean, _) in means.items()},
                "deviation": {key: deviation for key, (_, deviation) in means.items()},
                "runs": rows,
            }
        )
    sentences = warnings(groups)
    missing = [run.name for run in runs if run.name not in lines]
    if missing:
        sentences.append(
            f"Without scores, since they were not evaluated: {', '.join(missing)}. "
            "Runs with --test-every none hold out no view."
        )
    return {
        "levels": levels,
        "equal_seconds": shortest,
        "warnings": sentences,
        "equal": {key: runs[0].options.get(key) for key in equal(runs)},
        "different": different,
        "groups": compared,
    }


def _psnr(run: Trained) -> scores.Curve:
    return scores.curve(run.records, "train_seconds", "psnr_cc", "eval")


def _numbers(run: Trained, levels: Sequence[float], shortest: float | None) -> dict[str, Any]:
    """One run's part of compare.json."""
    line = _psnr(run)
    crossings = [scores.reached(line, level) or (None, False) for level in levels]
    return {
        "folder": run.name,
        "seed": run.options.get("seed"),
        "finished": run.finished,
        **{key: _last(run.records, key, None) for key, _, _ in COSTS},
        **{key: _last(run.records, key, "eval") for key, _, _ in SCORES},
        EQUAL: None if shortest is None else scores.value_at(line, shortest),
        "best_psnr_cc": float(max(line[1])) if len(line[1]) else None,
        "reached": [
            {"psnr_cc": level, "seconds": seconds, "upper_bound": bound}
            for level, (seconds, bound) in zip(levels, crossings)
        ],
    }


def _last(records: Sequence[scores.Record], key: str, event: str | None) -> Any:
    return next(
        (
            record[key]
            for record in reversed(records)
            if record.get(key) is not None and event in (None, record.get("event"))
        ),
        None,
    )


def levels_from(groups: Iterable[Sequence[scores.Curve]]) -> list[float]:
    """Up to three PSNR levels, dB, from the curves of each group's runs.

    They are the highest that all runs reach, the highest that a whole group reaches, and one below.
    """
    best = [min(max(y) for _, y in group) for group in groups if group]
    if not best:
        return []
    common, highest = (math.floor(level / LEVEL_STEP) * LEVEL_STEP for level in (min(best), max(best)))
    return sorted({common - 1, common, highest if highest > common else common - 2})


def final_table(result: Mapping[str, Any]) -> Table:
    """The end of the runs, a row for each group, with what any of them has."""
    groups = result["groups"]
    shown = [column for column in (*COSTS, *SCORES) if any(group["mean"][column[0]] is not None for group in groups)]
    rows = []
    for group in groups:
        mean, deviation = group["mean"], {key: group["deviation"][key] for key in SPREAD}
        rows.append(
            (
                group["name"],
                str(len(group["runs"])),
                ", ".join(str(run["seed"]) for run in group["runs"]),
                *(_with_spread(mean[key], deviation.get(key), form) for key, _, form in shown),
            )
        )
    return Table(
        "At the end",
        ("group", "runs", "seeds", *(title for _, title, _ in shown)),
        rows,
        range(3, 3 + len(shown)),
        FINAL_NOTES,
    )


def time_table(result: Mapping[str, Any]) -> Table:
    """Training time at given PSNR, and PSNR at equal training time, a row for each group."""
    rows = []
    for group in result["groups"]:
        runs, cells = group["runs"], []
        for crossings in zip(*(run["reached"] for run in runs)):  # of one level
            bound = "≤ " if any(each["upper_bound"] for each in crossings) else ""
            cells.append(_of_all([each["seconds"] for each in crossings], ",.1f", bound))
        equal = _of_all([run[EQUAL] for run in runs], ".2f")
        rows.append((group["name"], *cells, equal))
    seconds, levels = result["equal_seconds"], result["levels"]
    last = "at equal time" if seconds is None else f"PSNR cc at {seconds:,.1f} s, dB"
    return Table(
        "Against training time",
        ("group", *(f"to {level:g} dB, s" for level in levels), last),
        rows,
        range(1, len(levels) + 2),
        TIME_NOTES,
    )


def different_table(groups: Mapping[str, Sequence[Trained]]) -> Table:
    """The options and facts that differ between the groups."""
    runs = [group[0] for group in groups.values()]
    different = [(title(key), *(run.text(key) for run in runs)) for key in differing(runs)]
    return Table(
        "What differs",
        ("", *groups),
        different or [("nothing", *("" for _ in runs))],
        notes=(
            "Seeds, and options that change neither model nor time, are left out; -: the schedule does not use it.",
        ),
    )


def _of_all(values: Sequence[float | None], form: str, bound: str = "") -> str:
    """The mean and deviation if all runs of a group have a value, else how many have."""
    count = sum(value is not None for value in values)
    return (
        bound + _with_spread(*scores.spread(values), form) if count == len(values) else f"{count} of {len(values)} runs"
    )


def _with_spread(mean: float | None, deviation: float | None, form: str) -> str:
    if mean is None:
        return "-"
    return f"{mean:{form}}" + ("" if deviation is None else f" ± {deviation:{form}}")
