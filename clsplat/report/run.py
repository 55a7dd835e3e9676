"""The page of one run: pictures, scores, growth, loss and level changes."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from clsplat.config.option import options_of
from clsplat.evaluation.pictures import Pictures
from clsplat.io.runs.run import RunFolder
from clsplat.options import TrainOptions
from clsplat.report.city import city_sections
from clsplat.report.curves import Record
from clsplat.report.drawing import drawn
from clsplat.report.figures import score_figure, step_figure
from clsplat.report.groups import full_name
from clsplat.report.page import Table, folded, headed, html_of, page
from clsplat.report.pictures import pictures_html
from clsplat.report.scores import main_psnr, number, score_table, with_quality
from clsplat.report.survey import survey_html
from clsplat.scene import Scene

FACTS = ("command", "date", "scene", "scene_absolute", "fingerprint", "extent", "offset",
         "opencl_device", "kernel_form", "version", "commit")
PREDICTED = ("Held-out views have an exposure that follows from the training photos alone: {:.0%} "
             "interpolated between those before and after, the rest the mean of all.")


def write_report(run: RunFolder, pictures: Pictures | None = None, scene: Scene | None = None
                 ) -> Path:
    """Write the report of a run from its options and metrics, and return its path.

    Sections without records, such as the levels of a schedule that has none, are left out.

    Parameters
    ----------
    run : the folder of the run, or of a city.
    pictures : the beginning of the page.
    scene : at the size of its photos, for the section Survey.
    """
    options, records = run.read_options(), run.past_records()
    scores = drawn("PSNR and SSIM over training time", score_figure, records)
    sections = (
        pictures_html(pictures), survey_html(scene),
        headed("Scores over training time" if scores else "Scores", scores, score_table(records)),
        *city_sections(run.path, records),
        headed("Growth and loss", drawn("Gaussians, loss and level over iterations",
                                         step_figure, records)),
        plan_table(records), level_table(records),
        folded("Options", option_table(options).html()))
    return run.write_report(page(full_name(run.path, options), lead(options, records),
                                 html_of(*sections), made=options))


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
              and main_psnr(record) is not None]
    if scores:
        views, weight = scores[-1].get("views"), scores[-1].get("exposure_weight")
        tested = "held-out views" if views is None else f"{views} held-out view{'s' * (views != 1)}"
        main, fitted = main_psnr(scores[-1]), scores[-1].get("psnr_cc")
        text += f" PSNR on {tested}{'' if weight is None else ', after the colour fit'}: "
        # of the fit are the scores beside the pictures, which are higher
        text += with_quality(main) + ("." if fitted in (None, main) else
                                      f", after the colour fit {fitted:.2f} dB.")
        if weight is not None:
            text += f" {PREDICTED.format(weight)}"
    return f"{text} Schedule {options.get('schedule', '?')}, seed {options.get('seed', '?')}."


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
                number(record, "iteration", ",.0f"), number(record, "train_seconds", ",.1f"),
                f"{'-' if before is None else format(before, 'g')} → "
                f"{number(record, 'level', 'g')}", str(record.get("reason") or "-"),
                number(record, "since", ",.0f"), number(record, "slope", ".3g"),
                number(record, "threshold", ".3g"), number(record, "frequency", ".3g"),
                number(record, "hits", ".0f"), number(record, "rounds", ".0f"),
                number(record, "gaussians", ",.0f")))
        before = record.get("level") if record.get("level") is not None else before
    return Table("Level changes", (
        "step", "training, s", "level", "reason", "steps at it", "slope", "threshold", "frequency",
        "hits", "rounds", "gaussians"), rows, (0, 1, *range(4, 11)),
        ("A level has converged when the slope of the scene frequency, per step, is below the "
         "threshold convergence_hits times in a row (hits). Rounds: of growth, at that level.",)
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
