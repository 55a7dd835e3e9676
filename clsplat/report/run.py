"""The page of one run: scores, growth, loss, frequency and why the level changed."""

import dataclasses
from pathlib import Path

from clsplat.options import TrainOptions
from clsplat.report.figures import frequency_figure, score_figure, step_figure
from clsplat.report.page import Table, folded, page, picture

FACTS = ("scene", "fingerprint", "extent", "offset", "opencl_device", "kernel_form", "version",
         "commit")


def write_report(run, *more):
    """Write the report of a RunFolder from its options and metrics; returns the page's path.

    Parts without records, such as the levels of a schedule that has none, are left out. more:
    Tables and HTML that follow the scores.
    """
    options, records = run.read_options(), run.records()
    scores, steps, frequency = (draw(records) for draw in
                                (score_figure, step_figure, frequency_figure))
    parts = (
        scores and _drawn("Held-out views", scores), score_table(records), *more,
        plan_table(records),
        steps and _drawn("Growth and loss", steps), level_table(records),
        frequency and _drawn("Scene frequency", frequency))
    lead = (f"{options.get('schedule', '?')} schedule, seed {options.get('seed', '?')}, "
            f"{options.get('opencl_device', 'unknown device')}")
    if records:
        last = records[-1]
        lead += (f", {last.get('iteration') or 0:,} steps in {last.get('train_seconds') or 0:,.1f} "
                 f"s of training, {last.get('gaussians') or 0:,} gaussians")
    html = [part if isinstance(part, str) else part.html() for part in parts if part]
    scene = Path(options.get("scene") or "?").stem
    return run.write_report(page(f"{run.path.resolve().name}: training of {scene}", lead + ".",
                                 *html, folded("Options", option_table(options).html())))


def score_table(records):
    """Every evaluation, one row each; None without any."""
    rows = [(_number(record, "iteration", ",.0f"), _number(record, "train_seconds", ",.1f"),
             *(_number(record, key, form) for key, form in (
                 ("psnr_cc", ".2f"), ("psnr", ".2f"), ("ssim_cc", ".4f"), ("ssim", ".4f"),
                 ("gaussians", ",.0f"))))
            for record in records if record.get("event") == "eval"]
    return Table("", ("step", "training, s", "PSNR cc, dB", "PSNR, dB", "SSIM cc",
                                 "SSIM", "gaussians"), rows, range(7),
                 ("Means over the held-out views; cc: after a quadratic fit of each render's "
                  "colours to its photo.",)) if rows else None


def plan_table(records):
    """What was decided before training, and why; None without a plan."""
    rows = [(name.replace("_", " "), str(reason)) for record in records
            if record.get("event") == "plan"
            for name, reason in (record.get("reasons") or {}).items()]
    return Table("Plan", ("decision", "reason"), rows) if rows else None


def level_table(records):
    """Each change of the level, what decided it and on which numbers; None without any."""
    rows, before = [], None
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
         "threshold as often in a row as asked for (hits). Rounds: of growth, at that level.",)
        ) if rows else None


def option_table(options):
    """Facts first, then options in their order, then what else was recorded."""
    known = (*FACTS, *(option.name for option in dataclasses.fields(TrainOptions)))
    names = [name for name in known if name in options]
    names += [name for name in options if name not in known]
    return Table("", ("option", "value"),
                 [(name.replace("_", " "), str(options[name])) for name in names])


def _drawn(heading, figure):
    return f"<h2>{heading}</h2>\n{picture(figure, f'{heading}, as curves')}"


def _number(record, key, form):
    return "-" if record.get(key) is None else format(record[key], form)
