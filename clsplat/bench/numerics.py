"""The page of `precision`: the error and the time of each default, as Markdown or as HTML with
figures.

Both have the same sections, which are made from the records alone.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from typing import Any

from matplotlib.figure import Figure

from clsplat.report.drawing import drawn
from clsplat.report.figures import COLOURS
from clsplat.report.page import Table, page

from .variants import KNOBS

TITLE = "Numerics: error against run time"
LEAD = (
    "Made by `clsplat bench precision --markdown`; do not edit. A frame of the aerial city, "
    "rendered and differentiated under every approximation that the kernels could use. Times "
    "are of forward and adjoint without a loss. Image errors are in units of its range, 0 to 1. "
    "A gradient's error is relative: the L2 norm of the difference over that of the reference; "
    "of the worst element, the difference over the reference's largest element. `rounding` is "
    "against a double build of the same sum, `same order` against that in the order that "
    "single-precision depths give, `no cutoff` and `no stop` against double builds without the "
    "alpha cutoff or the transmittance stop.")
KINDS = {"rounding": "rounding", "same_order": "same order",
         "no_cutoff": "no cutoff", "no_stop": "no stop"}
# knob -> why the default is where it is
REASONS = {
    "precision": (
        "Rounding in float is far below what the alpha cutoff leaves out, so double gives digits "
        "that nothing uses."),
    "exponential": (
        "Degree 3 shows in the image's mean; from degree 4 on the error is that of float, and exp "
        "has the same. Degree 6 is exact up to rounding, for two more multiply-adds. native_exp2 "
        "is as accurate as the device makes it: the group form uses it where it was found accurate."
    ),
    "compiler flags": (
        "Fused multiply-adds and flushed denormals make no visible difference, and save too "
        "little time for a flag. -cl-fast-relaxed-math lets a compiler cancel the addition that "
        "rounds the polynomial's exponent, and the image is wrong."),
    "storage": (
        "Half has 11 bits: splats lose more than rounding ever does, and pair sums are below its"
        " range unless scaled, and then still lose more. Both are excluded by their error, so they "
        "were not built and have no time."),
    "alpha cutoff": (
        "An alpha of 1/255 is one step of an 8-bit photo. Larger cutoffs cost accuracy in "
        "proportion; smaller ones cost time and change the image's mean by less than a step."),
    "transmittance stop": (
        "At 1e-4 the omitted light is about as small as rounding. A threshold ten times larger "
        "loses ten times as much, and never stopping gains less than rounding loses."),
    "tiles": (
        "The exact ellipse draws the same image with fewer pairs: a box only adds work."),
}
# a variant is better with at most this share of the default's time, and of its error
BETTER_TIME, BETTER_ERROR = 0.95, 1.1
Record = dict[str, Any]  # see `precision.measured`


@dataclass(frozen=True)
class Section:
    """A section of the page: its text in Markdown, and a table."""

    title: str
    text: str
    table: Table


def gradient_error(record: Record, kind: str) -> float:
    """The largest L2 error of a gradient."""
    return max(float(gradient["l2"]) for gradient in record[kind]["gradients"].values())


def default_of(records: Sequence[Record], record: Record) -> Record:
    """The record of the default on the same device, form and scene as `record`."""
    return next(other for other in records
                if other["knob"] == "default" and _place(other) == _place(record))


def sections(records: Sequence[Record]) -> list[Section]:
    """The sections of the page."""
    return [_machines(records), _defaults(records),
            *(_knob(records, knob) for knob in KNOBS)]


def _place(record: Record) -> tuple[Any, ...]:
    return record["device"], record["driver"], record["form"], record["size"]["gaussians"]


def _label(record: Record) -> str:
    """A short name of the measurement: platform, form and size."""
    platform = record["platform"].split("(")[0].replace("Portable Computing Language", "PoCL")
    count = record["size"]["gaussians"] // 1000
    return f"{platform.split()[0]} {record['form']} {count}k"


def _machines(records: Sequence[Record]) -> Section:
    rows = []
    for record in records:
        if record["knob"] == "default":
            size, (low, high) = record["size"], record["quartiles_ms"]
            rows.append((
                _label(record), record["device"], record["driver"], record["form"],
                f"{size['gaussians']:,} at {size['width']}x{size['height']}",
                f"{record['median_ms']:.1f} ({low:.1f} to {high:.1f})", record["command"]))
    return Section("Where", "Medians and quartiles of the default's time.", Table(
        "", ("name", "device", "driver", "form", "gaussians", "ms", "command"), rows, (5,)))


def _defaults(records: Sequence[Record]) -> Section:
    rows = []
    for record in records:
        if record["knob"] == "default":
            for kind, title in KINDS.items():
                error = record[kind]
                rows.append((_label(record), title, "image", f"{error['image_mean']:.1e}",
                             f"{error['image_max']:.1e}",
                             f"{error['image_above']:.1e} of its values are off by more than 1e-4"))
                rows += [(_label(record), title, name, f"{gradient['l2']:.1e}",
                          f"{gradient['worst']:.1e}", gradient["element"])
                         for name, gradient in error["gradients"].items()]
    return Section(
        "The default", "What remains of the image's largest error under `same order` is pixels "
        "where rounding takes a splat across the alpha cutoff: a step has no smaller error.",
        Table("", ("where", "against", "of", "L2 (mean)", "worst (max)", "element"), rows, (3, 4)))


def _knob(records: Sequence[Record], knob: str) -> Section:
    name, kind = KNOBS[knob]
    rows, better = [], []
    for record in records:
        if record["knob"] not in (knob, "default"):
            continue
        error, default = record[kind], default_of(records, record)
        variant = name + " (default)" if record is default else record["variant"]
        worst = max(error["gradients"].values(), key=lambda gradient: gradient["worst"])
        time, ratio = "", ""
        if "median_ms" in record:
            share = record["median_ms"] / default["median_ms"]
            time, ratio = f"{record['median_ms']:.1f}", f"{share:.2f}"
            if share <= BETTER_TIME and gradient_error(
                    record, kind) <= BETTER_ERROR * gradient_error(default, kind):
                better.append(f"{variant} on {_label(record)} ({share:.2f} of the time)")
        rows.append((variant, _label(record), time, ratio, f"{error['image_max']:.1e}",
                     f"{error['image_mean']:.1e}",
                     *(f"{gradient['l2']:.1e}" for gradient in error["gradients"].values()),
                     f"{worst['worst']:.1e}", worst["element"]))
    verdict = (f"Measured here as no worse and faster: {'; '.join(better)}." if better
               else "No other was measured as no worse and faster.")
    head = ("variant", "where", "ms", "of default", "image max", "image mean",
            *(records[0][kind]["gradients"]), "worst", "element")
    numbers = tuple(range(2, len(head) - 1))
    text = f"Default: {name}. {REASONS[knob]} {verdict} Errors: {KINDS[kind]}."
    return Section(knob.capitalize(), text, Table("", head, rows, numbers))


def markdown(records: Sequence[Record]) -> str:
    """The page as Markdown."""
    parts = [f"# {TITLE}\n\n{LEAD}\n"]
    for section in sections(records):
        table = section.table
        bars = ["--:" if column in table.numbers else "---" for column in range(len(table.head))]
        lines = [table.head, bars, *table.rows]
        parts.append(f"\n## {section.title}\n\n{section.text}\n\n" + "".join(
            f"| {' | '.join(cells)} |\n" for cells in lines))
    return "".join(parts)


def html(records: Sequence[Record]) -> str:
    """The page as self-contained HTML."""
    parts = ["<p>The largest L2 error of a gradient over time; a ring is the default.</p>\n",
             drawn("error of the gradients over time, a panel a choice", error_figure, records)]
    for section in sections(records):
        text = escape(section.text.replace("`", ""), quote=False)
        parts.append(f"<h2>{section.title}</h2>\n<p>{text}</p>\n{section.table.html()}")
    return page(TITLE, LEAD.replace("`", ""), *parts)


def error_figure(records: Sequence[Record], narrow: bool = False) -> Figure:
    """The largest L2 error of a gradient over the time relative to the default's.

    Each knob has a panel and each device a colour; a ring is the default.
    """
    knobs = [knob for knob in KNOBS
             if any(r["knob"] == knob and "median_ms" in r for r in records)]
    colours: dict[str, str] = {}
    columns = 1 if narrow else 2
    figure = Figure(figsize=(5 * columns, 3.2 * -(-len(knobs) // columns)), layout="constrained")
    panels = figure.subplots(-(-len(knobs) // columns), columns, squeeze=False).flat
    for knob, axes in zip(knobs, panels):
        kind = KNOBS[knob][1]
        for record in records:
            if record["knob"] not in (knob, "default") or "median_ms" not in record:
                continue
            default = default_of(records, record)
            label = _label(record)
            colour = colours.setdefault(label, COLOURS[len(colours) % len(COLOURS)])
            # double is its own reference: an error of 0 has no place on this axis
            at = (record["median_ms"] / default["median_ms"],
                  max(gradient_error(record, kind), 1e-8))
            axes.plot(*at, "o", color=colour, markersize=9 if record is default else 5,
                      fillstyle="none" if record is default else "full", label=label)
            if record is not default:
                axes.annotate(record["variant"], at, xytext=(3, 3), fontsize=8, rotation=35,
                              textcoords="offset points", annotation_clip=False)
        axes.set_title(f"{knob} ({KINDS[kind]})")
        axes.set_yscale("log")
        low, high = axes.get_ylim()
        axes.set_ylim(low / 2, high * 5)  # room for names, and for errors that are all equal
        axes.set_xlabel("time, default = 1")
    for axes in list(panels):
        axes.set_visible(False)
    handles = dict(zip(*reversed(figure.axes[0].get_legend_handles_labels())))
    figure.legend(handles.values(), handles.keys(), loc="outside upper left", ncols=4)
    return figure
