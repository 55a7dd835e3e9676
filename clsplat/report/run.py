"""The page of one run: pictures, scores, growth, loss, level changes and scene frequency."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from clsplat.config.option import options_of
from clsplat.evaluation.pictures import Pictures
from clsplat.io.run import RunFolder
from clsplat.options import TrainOptions
from clsplat.report.curves import Record
from clsplat.report.drawing import drawn
from clsplat.report.figures import frequency_figure, score_figure, step_figure
from clsplat.report.groups import scene_name
from clsplat.report.page import Table, folded, headed, html_of, page
from clsplat.report.pictures import pictures_html, with_pictures

FACTS = ("scene", "scene_absolute", "fingerprint", "extent", "offset", "opencl_device",
         "kernel_form", "version", "commit")
# of the scores: key, title, format
COLUMNS = (("iteration", "step", ",.0f"), ("train_seconds", "training, s", ",.1f"),
           ("psnr_cc", "PSNR cc, dB", ".2f"), ("psnr", "PSNR, dB", ".2f"),
           ("ssim_cc", "SSIM cc", ".4f"), ("ssim", "SSIM", ".4f"))
PERCEPTUAL = (("flip_cc", "FLIP cc", ".4f"), ("flip", "FLIP", ".4f"),
              ("lpips_cc", "LPIPS cc", ".4f"), ("lpips", "LPIPS", ".4f"))  # where a run has them
PREDICTED = ("Held-out views have an exposure that follows from the training photos alone: {:.0%} "
             "interpolated between those before and after, the rest the mean of all.")
GAUSSIANS = ("gaussians", "gaussians", ",.0f")
# comments around the table of scores, by which `renewed` finds it
BEGIN, END = "<!-- scores -->\n", "<!-- end of scores -->\n"
FREQUENCY = (
    "<p class=note>The scene frequency is the mean of 1 / size over the gaussians, weighted by how "
    "visible each of them is: it rises as they become finer. The sig schedule continues with finer "
    "images when it has stopped rising. It helps to understand the method, not to judge the model."
    "</p>\n")


def write_report(run: RunFolder, *more: Table | str | None, pictures: Pictures | None = None
                 ) -> Path:
    """Write the report of a run from its options and metrics, and return its path.

    Parts without records, such as the levels of a schedule that has none, are left out.

    Parameters
    ----------
    more : tables and HTML that follow the scores.
    pictures : the beginning of the page.
    """
    options, records = run.read_options(), run.records()
    frequency = drawn("Scene frequency over iterations", frequency_figure, records)
    scores = drawn("PSNR and SSIM over training time", score_figure, records)
    parts = (
        pictures_html(pictures),
        headed("Scores over training time" if scores else "Scores", scores, _scores(records)),
        *more,
        headed("Growth and loss", drawn("Gaussians, loss and level over iterations",
                                         step_figure, records)),
        plan_table(records), level_table(records),
        folded("Options", option_table(options).html()),
        frequency and folded("Scene frequency", FREQUENCY + frequency))
    return run.write_report(page(f"{scene_name(options)}: run {run.path.resolve().name}",
                                 lead(options, records), html_of(*parts)))


def renew_report(run: RunFolder, pictures: Pictures) -> Path:
    """Replace the pictures and the table of scores in the report of a run, and return its path.

    The report is written anew if it is missing or has no section of pictures.
    """
    html = run.read_report()
    html = html and with_pictures(html, pictures)
    if not html:
        return write_report(run, pictures=pictures)
    before, begin, rest = html.partition(BEGIN)
    _, end, after = rest.partition(END)
    scores = _scores(run.past_records())
    return run.write_report(f"{before}{scores}{after}" if begin and end and scores else html)


def _scores(records: Sequence[Record]) -> str | None:
    table = score_table(records)
    return f"{BEGIN}{table.html()}{END}" if table else None


def lead(options: Mapping[str, Any], records: Sequence[Record]) -> str:
    """What was trained, how well and for how long, in a few sentences."""
    device = options.get("opencl_device") or "a device that is not recorded"
    if not records:
        return f"This training on {device} has no records."
    last = records[-1]
    text = (f"A model of {last.get('gaussians') or 0:,} gaussians, trained in "
            f"{_duration(last.get('train_seconds') or 0)} ({last.get('iteration') or 0:,} steps) "
            f"on {device}.")
    scores = [record for record in records if record.get("event") == "eval"
              and record.get("psnr_cc") is not None]
    if scores:
        views, plain = scores[-1].get("views"), scores[-1].get("psnr")
        tested = "held-out views" if views is None else f"{views} held-out view{'s' * (views != 1)}"
        text += (f" PSNR on {tested}: {scores[-1]['psnr_cc']:.2f} dB after the colour fit"
                 f"{'' if plain is None else f', {plain:.2f} dB plain'}.")
        if scores[-1].get("exposure_weight") is not None:
            text += f" {PREDICTED.format(scores[-1]['exposure_weight'])}"
    return f"{text} Schedule {options.get('schedule', '?')}, seed {options.get('seed', '?')}."


def score_table(records: Sequence[Record]) -> Table | None:
    """A row for each evaluation; None without any."""
    evaluations = [record for record in records if record.get("event") == "eval"]
    columns = [*COLUMNS, *(column for column in PERCEPTUAL if any(
        record.get(column[0]) is not None for record in evaluations)), GAUSSIANS]
    rows = [tuple(_number(record, key, form) for key, _, form in columns)
            for record in evaluations]
    note = ("Means over the held-out views; cc: after a quadratic fit of each render's colours to "
            "its photo.")
    if len(columns) > len(COLUMNS) + 1:
        note += (" FLIP and LPIPS, lower is better, are close to what people see; they are "
                 "computed for the finished model only.")
    return Table("", tuple(title for _, title, _ in columns), rows, range(len(columns)),
                 (note,)) if rows else None


def plan_table(records: Sequence[Record]) -> Table | None:
    """The decisions before training, with their reasons; None without a plan."""
    rows = [(name.replace("_", " "), str(reason)) for record in records
            if record.get("event") == "plan"
            for name, reason in (record.get("reasons") or {}).items()]
    return Table("Plan", ("decision", "reason"), rows) if rows else None


def level_table(records: Sequence[Record]) -> Table | None:
    """A row for each change of the level, with the reason and its numbers; None without any."""
    rows: list[tuple[str, ...]] = []
    before = None
    for record in records:
        if record.get("event") == "level":
            rows.append((
                _number(record, "iteration", ",.0f"), _number(record, "train_seconds", ",.1f"),
                f"{'-' if before is None else format(before, 'g')} → "
                f"{_number(record, 'level', 'g')}", str(record.get("reason") or "-"),
                _number(record, "since", ",.0f"), _number(record, "slope", ".3g"),
                _number(record, "threshold", ".3g"), _number(record, "frequency", ".3g"),
                _number(record, "hits", ".0f"), _number(record, "rounds", ".0f"),
                _number(record, "gaussians", ",.0f")))
        before = record.get("level") if record.get("level") is not None else before
    return Table("Level changes", (
        "step", "training, s", "level", "reason", "steps at it", "slope", "threshold", "frequency",
        "hits", "rounds", "gaussians"), rows, (0, 1, *range(4, 11)),
        ("A level has converged when the slope of the scene frequency, per step, is below the "
         "threshold --convergence-hits times in a row (hits). Rounds: of growth, at that level.",)
        ) if rows else None


def option_table(options: Mapping[str, Any]) -> Table:
    """A row for each fact, then for each option in order, then for all else that was recorded."""
    known = (*FACTS, *(option.name for option in options_of(TrainOptions)))
    names = [name for name in known if name in options]
    names += [name for name in options if name not in known]
    return Table("", ("option", "value"),
                 [(name.replace("_", " "), str(options[name])) for name in names])


def _duration(seconds: float) -> str:
    """A duration for people, without units that are too small to matter."""
    if seconds < 100:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    return (f"{minutes} min {rest} s" if minutes < 100
            else f"{minutes // 60} h {minutes % 60} min")


def _number(record: Record, key: str, form: str) -> str:
    return "-" if record.get(key) is None else format(record[key], form)
