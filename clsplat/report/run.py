"""The page of one run: pictures, scores, growth, loss, why the level changed, and frequency."""

from clsplat.config.option import options_of
from clsplat.options import TrainOptions
from clsplat.report.drawing import drawn
from clsplat.report.figures import frequency_figure, score_figure, step_figure
from clsplat.report.groups import scene_name
from clsplat.report.page import Table, folded, headed, html_of, page
from clsplat.report.pictures import pictures_html, with_pictures

FACTS = ("scene", "scene_absolute", "fingerprint", "extent", "offset", "opencl_device",
         "kernel_form", "version", "commit")
FREQUENCY = (
    "<p class=note>The scene frequency is the mean of 1 / size over the gaussians, weighted by how "
    "much each of them shows: it rises as they become finer. The sig schedule goes on to finer "
    "images when it has stopped rising. It is of use to understand the method, not to judge the "
    "model.</p>\n")


def write_report(run, *more, pictures=None):
    """Write the report of a RunFolder from its options and metrics; returns the page's path.

    Parts without records, such as the levels of a schedule that has none, are left out. more:
    Tables and HTML that follow the scores; pictures: Pictures of evaluation/pictures.py, with which
    the page begins.
    """
    options, records = run.read_options(), run.records()
    frequency = drawn("Scene frequency over iterations", frequency_figure, records)
    scores = drawn("PSNR and SSIM over training time", score_figure, records)
    parts = (
        pictures_html(pictures),
        headed("Scores over training time" if scores else "Scores", scores, score_table(records)),
        *more,
        headed("Growth and loss", drawn("Gaussians, loss and level over iterations",
                                         step_figure, records)),
        plan_table(records), level_table(records),
        folded("Options", option_table(options).html()),
        frequency and folded("Scene frequency", FREQUENCY + frequency))
    return run.write_report(page(
        f"{scene_name(options)}: run {run.path.resolve().name}", lead(options, records),
        *map(html_of, filter(None, parts))))


def renew_pictures(run, pictures):
    """Put Pictures into the report of a run, which is written if there is none that has room for
    them; returns its path."""
    html = run.read_report()
    html = html and with_pictures(html, pictures)
    return run.write_report(html) if html else write_report(run, pictures=pictures)


def lead(options, records):
    """What was trained, how well and how long, in a sentence or two."""
    device = options.get("opencl_device") or "a device that is not recorded"
    if not records:
        return f"Nothing is recorded of this training on {device}."
    last = records[-1]
    text = (f"A model of {last.get('gaussians') or 0:,} gaussians, trained in "
            f"{_duration(last.get('train_seconds') or 0)} ({last.get('iteration') or 0:,} steps) "
            f"on {device}.")
    scores = [record for record in records if record.get("event") == "eval"
              and record.get("psnr_cc") is not None]
    if scores:
        views, plain = scores[-1].get("views"), scores[-1].get("psnr")
        seen = "held-out views" if views is None else f"{views} held-out view{'s' * (views != 1)}"
        text += (f" PSNR on {seen}: {scores[-1]['psnr_cc']:.2f} dB after the colour fit"
                 f"{'' if plain is None else f', {plain:.2f} dB plain'}.")
    return f"{text} Schedule {options.get('schedule', '?')}, seed {options.get('seed', '?')}."


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
    known = (*FACTS, *(option.name for option in options_of(TrainOptions)))
    names = [name for name in known if name in options]
    names += [name for name in options if name not in known]
    return Table("", ("option", "value"),
                 [(name.replace("_", " "), str(options[name])) for name in names])


def _duration(seconds):
    """Seconds in words: of the units that matter."""
    if seconds < 100:
        return f"{seconds:.1f} s"
    minutes, seconds = divmod(round(seconds), 60)
    return (f"{minutes} min {seconds} s" if minutes < 100
            else f"{minutes // 60} h {minutes % 60} min")


def _number(record, key, form):
    return "-" if record.get(key) is None else format(record[key], form)
