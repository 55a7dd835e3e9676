"""The page of one run: pictures, scores, growth, loss and level changes."""

import base64
from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.evaluation.held_out_responses import Predicted
from clsplat.evaluation.pictures import COLOURS, LARGEST_ERROR, Pictures, ShownView
from clsplat.io.photos.images import encode_image
from clsplat.io.runs.run import RunFolder
from clsplat.report import scores as measures
from clsplat.report.charts import drawn, score_chart, step_chart
from clsplat.report.city import city_sections
from clsplat.report.page import Table, folded, full_name, headed, html_of, page
from clsplat.report.scores import Record, main_psnr, number, score_table, with_quality
from clsplat.report.survey import survey_html
from clsplat.scene import Scene

JPEG_QUALITY = 85
# attribute of a ShownView, caption
PANELS = (("photo", "photo"), ("render", "render after the colour fit"), ("error", "its error"))


def write_report(run: RunFolder, pictures: Pictures | None = None, scene: Scene | None = None) -> Path:
    """Write the report of a run from its options and metrics, and return its path.

    Sections without records, such as the levels of a schedule that has none, are left out.

    Parameters
    ----------
    run : the folder of the run, or of a city.
    pictures : the beginning of the page.
    scene : at the size of its photos, for the section Survey.
    """
    options, records = run.read_options(), run.records()
    scores = drawn("PSNR and SSIM over training time", score_chart, records)
    sections = (
        pictures_html(pictures),
        survey_html(scene),
        headed("Scores over training time" if scores else "Scores", scores, score_table(records)),
        *city_sections(run.path, records),
        headed("Growth and loss", drawn("Gaussians, loss and level over iterations", step_chart, records)),
        _plan_table(records),
        level_table(records),
        _time_table(records),
        folded(
            "Options",
            Table(
                "", ("option", "value"), [(name.replace("_", " "), str(value)) for name, value in options.items()]
            ).html(),
        ),
    )
    return run.write_report(
        page(full_name(run.path, options), lead(options, records), html_of(*sections), made=options)
    )


def lead(options: Mapping[str, Any], records: Sequence[Record]) -> str:
    """What was trained, how well and for how long, in a few sentences."""
    device = options.get("opencl_device") or "a device that is not recorded"
    if not records:
        return f"This training on {device} has no records."
    last = records[-1]
    blocks = ", the sum of its blocks" * any(each.get("event") == "merge" for each in records)
    text = (
        f"A model of {last.get('gaussians') or 0:,} gaussians, trained in "
        f"{_duration(last.get('train_seconds') or 0)}{blocks} "
        f"({last.get('iteration') or 0:,} steps) on {device}."
    )
    scores = [record for record in records if record.get("event") == "eval" and main_psnr(record) is not None]
    if scores:
        views, weight = scores[-1].get("views"), scores[-1].get("exposure_weight")
        tested = "held-out views" if views is None else f"{views} held-out view{'s' * (views != 1)}"
        main, fitted = main_psnr(scores[-1]), scores[-1].get("psnr_cc")
        text += f" PSNR on {tested}{'' if weight is None else ', after the colour fit'}: "
        # of the fit are the scores beside the pictures, which are higher
        text += with_quality(main) + ("." if fitted in (None, main) else f", after the colour fit {fitted:.2f} dB.")
        if weight is not None:
            text += f" Exposure of held-out views: {Predicted(weight=weight)}."
    return f"{text} Schedule {options.get('schedule', '?')}, seed {options.get('seed', '?')}."


def pictures_html(pictures: Pictures | None) -> str:
    """The section of a report for its pictures."""
    if not pictures or not pictures.shown:
        return ""
    views = "".join(map(_view, pictures.shown))
    if pictures.held_out:
        title = "Held-out views"
        which = "Photos that the training did not use, beside renders of the same views."
    else:
        title = "Training views"
        which = (
            "No view is held out, so these photos were trained on, and are a weaker "
            f"test than others would be. They were chosen from {pictures.count}."
        )
    colours = ", ".join(f"rgb{colour}" for colour in COLOURS)
    return (
        f"<h2>{title}</h2>\n<p>{which} PSNR measures how similar the two are after the colour "
        f"fit. {measures.EXPLAINED}</p>\n"
        "<div class=scale><b>error: none</b> "
        f'<i style="background: linear-gradient(to right, {colours})"></i>'
        f"{LARGEST_ERROR:.0%} of full brightness or more</div>\n{views}"
        "<p class=note>The colour fit is a quadratic fit of each render's colours to its "
        "photo; the error is the mean difference of red, green and blue. The PNG files of "
        "<code>clsplat eval</code> have the renders without the fit, too.</p>\n"
    )


def _view(view: ShownView) -> str:
    name, scores = escape(view.scores["name"]), view.scores
    title = {"only": name}.get(view.place, f"{view.place.capitalize()}: {name}")
    panels = "\n".join(
        f"<figure>{jpeg(getattr(view, panel), f'{panel} of {name}')}<figcaption>{caption}</figcaption></figure>"
        for panel, caption in PANELS
    )
    return (
        f"<div class=view>\n<h3>{title}</h3>\n"
        f"<p>PSNR {with_quality(scores['psnr_cc'])}, SSIM {number(scores, 'ssim_cc', '.4f')}"
        "</p>\n"
        f"<div class=panels>\n{panels}\n</div>\n</div>\n"
    )


def jpeg(pixels: NDArray[np.uint8], description: str) -> str:
    """HTML of an image [H, W, 3] with an escaped description."""
    height, width = pixels.shape[:2]
    data = base64.b64encode(encode_image(pixels, "jpg", JPEG_QUALITY, "JPEG")).decode()
    return (
        f'<img alt="{description}" width={width} height={height} style="height: auto" '
        f'src="data:image/jpeg;base64,{data}">'
    )


def _plan_table(records: Sequence[Record]) -> Table | None:
    """The decisions before training, with their reasons; None without a plan."""
    rows = [
        (name.replace("_", " "), str(reason))
        for record in records
        if record.get("event") == "plan"
        for name, reason in (record.get("reasons") or {}).items()
    ]
    return Table("Plan", ("decision", "reason"), rows) if rows else None


def _time_table(records: Sequence[Record]) -> Table | None:
    """What the seconds of the process were spent for; None if that is not recorded."""
    spent = next((record["seconds"] for record in reversed(records) if record.get("event") == "time"), None)
    return (
        Table(
            "Time of the command",
            ("spent for", "seconds"),
            [(purpose, f"{seconds:.2f}") for purpose, seconds in spent.items()],
            (1,),
            ("Until this page was written.",),
        )
        if spent
        else None
    )


def level_table(records: Sequence[Record]) -> Table | None:
    """A row for each change of the level, with the reason; None without any."""
    rows = [
        (
            number(record, "iteration", ",.0f"),
            number(record, "train_seconds", ",.1f"),
            number(record, "level", "g"),
            number(record, "gaussians", ",.0f"),
            str(record.get("reason") or "-"),
        )
        for record in records
        if record.get("event") == "level"
    ]
    return (
        Table("Level changes", ("step", "training, s", "to level", "gaussians", "reason"), rows, range(4))
        if rows
        else None
    )


def _duration(seconds: float) -> str:
    """A duration for people, without units that are too small to matter."""
    if seconds < 100:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest} s" if minutes < 100 else f"{minutes // 60} h {minutes % 60} min"
