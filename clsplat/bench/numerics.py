"""The page of `precision`: what each default costs and saves, as Markdown or as HTML with drawings.

Both hold the same sections, made from the records alone.
"""

from dataclasses import dataclass
from html import escape

from matplotlib.figure import Figure

from clsplat.report.drawing import drawn
from clsplat.report.figures import COLOURS
from clsplat.report.page import Table, page

from .variants import KNOBS

TITLE = "Numerics: error against run time"
LEAD = (
    "Made by `clsplat bench precision --markdown`; do not edit. A frame of the aerial city, "
    "rendered and differentiated under every approximation that the kernels could take. Times "
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
        "Rounding in float is far below what the alpha cutoff leaves out, so double buys digits "
        "that nothing uses."),
    "exponential": (
        "Degree 3 shows in the image's mean; from degree 4 on the error is float's own, and exp "
        "has no less. Degree 6 is exact to rounding for two multiply-adds more. native_exp is as "
        "good as its device makes it: the group form takes it where it was seen accurate."),
    "compiler flags": (
        "Fused multiply-adds and flushed denormals change nothing that can be seen, and save "
        "nothing worth a flag. -cl-fast-relaxed-math lets a compiler cancel the addition that "
        "rounds the polynomial's exponent, and the image is wrong."),
    "storage": (
        "Half has 11 bits: splats lose more than rounding ever does, and pair sums are below its"
        " range unless scaled, and then still lose more. Not built, hence not timed: both are "
        "excluded by their error."),
    "alpha cutoff": (
        "An alpha of 1/255 is one step of an 8-bit photo. Coarser cutoffs cost accuracy in "
        "proportion; finer ones cost time for less than a step in the image's mean."),
    "transmittance stop": (
        "At 1e-4 what is left out is about as small as rounding. Stops ten times earlier lose ten "
        "times as much each, and never stopping gains less than rounding loses."),
    "tiles": (
        "The exact ellipse draws the same image with fewer pairs: a box only adds work."),
}
SAVES, AS_GOOD = 0.95, 1.1  # a variant is better: at most so much of the time and of the error


@dataclass(frozen=True)
class Section:
    title: str
    text: str
    table: Table


def gradient_error(record, kind):
    return max(gradient["l2"] for gradient in record[kind]["gradients"].values())


def default_of(records, record):
    """The default's record beside which `record` was measured."""
    return next(other for other in records
                if other["knob"] == "default" and _place(other) == _place(record))


def sections(records):
    """The page as a list of Section."""
    return [_machines(records), _defaults(records),
            *(_knob(records, knob) for knob in KNOBS)]


def _place(record):
    return record["device"], record["driver"], record["form"], record["size"]["gaussians"]


def _label(record):
    """A short name of where it ran: platform or device, form, size."""
    platform = record["platform"].split("(")[0].replace("Portable Computing Language", "PoCL")
    count = record["size"]["gaussians"] // 1000
    return f"{platform.split()[0]} {record['form']} {count}k"


def _machines(records):
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


def _defaults(records):
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


def _knob(records, knob):
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
            if share <= SAVES and gradient_error(record, kind) <= AS_GOOD * gradient_error(
                    default, kind):
                better.append(f"{variant} on {_label(record)} ({share:.2f} of the time)")
        rows.append((variant, _label(record), time, ratio, f"{error['image_max']:.1e}",
                     f"{error['image_mean']:.1e}",
                     *(f"{gradient['l2']:.1e}" for gradient in error["gradients"].values()),
                     f"{worst['worst']:.1e}", worst["element"]))
    found = (f"Measured here as no worse and faster: {'; '.join(better)}." if better
             else "No other was measured as no worse and faster.")
    head = ("variant", "where", "ms", "of default", "image max", "image mean",
            *(records[0][kind]["gradients"]), "worst", "element")
    numbers = tuple(range(2, len(head) - 1))
    text = f"Default: {name}. {REASONS[knob]} {found} Errors: {KINDS[kind]}."
    return Section(knob.capitalize(), text, Table("", head, rows, numbers))


def markdown(records):
    """The page as Markdown."""
    parts = [f"# {TITLE}\n\n{LEAD}\n"]
    for section in sections(records):
        table = section.table
        bars = ["--:" if column in table.numbers else "---" for column in range(len(table.head))]
        lines = [table.head, bars, *table.rows]
        parts.append(f"\n## {section.title}\n\n{section.text}\n\n" + "".join(
            f"| {' | '.join(cells)} |\n" for cells in lines))
    return "".join(parts)


def html(records):
    """The page as self-contained HTML."""
    parts = ["<p>The largest L2 error of a gradient over time; a ring is the default.</p>\n",
             drawn("error of the gradients over time, a panel a choice", error_figure, records)]
    for section in sections(records):
        text = escape(section.text.replace("`", ""), quote=False)
        parts.append(f"<h2>{section.title}</h2>\n<p>{text}</p>\n{section.table.html()}")
    return page(TITLE, LEAD.replace("`", ""), *parts)


def error_figure(records, narrow=False):
    """The largest L2 error of a gradient over the time relative to the default's, a panel a knob; a
    ring is the default, a colour a device."""
    knobs = [knob for knob in KNOBS
             if any(r["knob"] == knob and "median_ms" in r for r in records)]
    colours, columns = {}, 1 if narrow else 2
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
        axes.set_ylim(low / 2, high * 5)  # room for names, and no axis of a hair's width
        axes.set_xlabel("time, default = 1")
    for axes in list(panels):
        axes.set_visible(False)
    handles = dict(zip(*reversed(figure.axes[0].get_legend_handles_labels())))
    figure.legend(handles.values(), handles.keys(), loc="outside upper left", ncols=4)
    return figure
