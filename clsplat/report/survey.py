"""The section "Survey" of a report: maps of the cameras and of the overlap, and the errors."""

from __future__ import annotations

from collections.abc import Iterator
from html import escape

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from clsplat.evaluation.survey import Survey, missing_photos, spreads, survey_of
from clsplat.georeference import CHECK, CONTROL, LEFT_OUT
from clsplat.report.drawing import drawn
from clsplat.report.figures import COLOURS, NARROW, WIDE
from clsplat.report.page import Table, folded, headed, warning
from clsplat.scene import Scene

HEIGHTS = (3.0, 7.0)  # inches, of a map
MOST_ROWS = 60  # of a table; more points than these are named by no one
SHOWN = 5  # names in a sentence
ROLES = {CONTROL: "which decided the place", CHECK: "which took no part"}
NOTE = ("From the measured place to that in the scene. 90 % within: along the ground it is called "
        "CE90, and up LE90.")
LENGTHS = ((0.01, "mm", 1e3), (1.0, "cm", 1e2), (np.inf, "m", 1.0))  # below so many metres


def survey_html(scene: Scene | None) -> str:
    """The section of a report for a scene at the size of its photos; "" if it is no survey. An
    error becomes a line of text."""
    try:
        survey = None if scene is None else survey_of(scene)
        return _section(survey) if survey is not None and survey.is_known else ""
    except Exception as error:  # noqa: BLE001  (no survey is worth a page)
        return f"<p class=note>The survey could not be shown ({escape(str(error))}).</p>\n"


def _section(survey: Survey) -> str:
    maps = drawn(f"Map of the {len(survey.names)} cameras, and how many photos look at each place",
                 survey_figure, survey)
    maps = maps and f"<div class=plate>{maps}</div>\n"  # its colours stay as they are
    missing = list(missing_photos(survey.record).items())
    unused = Table("", ("photo", "reason"), missing[:MOST_ROWS],
                   notes=_more(len(missing), "photos", "sfm.json"))
    return headed(
        "Survey", *(warning(f"Warning: {text}") for text in warnings(survey)), facts_table(survey),
        maps, residuals_html(survey),
        folded("Photos that were not used", unused.html()) if missing else "")


def warnings(survey: Survey) -> tuple[str, ...]:
    """Sentences that the reader must not miss: those of the georeference and of `clsplat sfm`."""
    known, recorded = survey.georeference, survey.record.get("warnings")
    return tuple(dict.fromkeys(map(str, (
        *(known.warnings if known else ()), *(recorded if isinstance(recorded, list) else ())))))


def facts_table(survey: Survey) -> Table:
    """A row for each fact that is known."""
    return Table("", ("", ""), list(_facts(survey)))


def _facts(survey: Survey) -> Iterator[tuple[str, str]]:
    record, known, overlap = survey.record, survey.georeference, survey.overlap
    used = len(survey.names)
    given = record.get("photos")
    yield "photos used", f"{used:,} of {given:,}" if isinstance(given, int) else f"{used:,}"
    if known is not None:
        yield "georeference", f"{known.crs[:60]}, by the {known.source or 'files of the scene'}"
        if known.vertical:
            yield "heights", known.vertical
        yield "residual", _residual(survey)
        if left_out := [each.name for each in survey.residuals if each.role == LEFT_OUT]:
            rest = f" and {len(left_out) - SHOWN} more" if len(left_out) > SHOWN else ""
            yield "left out", f"{', '.join(left_out[:SHOWN])}{rest}, which contradict the others"
        if survey.pixel:
            yield "ground sampling distance", f"{length(survey.pixel)} a pixel of the photos"
        if survey.height:
            yield "distance of the ground", f"{length(survey.height)} from the cameras, median"
        if overlap is not None:
            yield "area covered", f"{area(overlap.covered)}, by at least two photos"
    else:
        yield "georeference", "none, so sizes are not known in metres"
    if overlap is not None:
        yield "overlap", (f"{overlap.mean:.1f} photos look at a place, in the mean; fewer than "
                          f"three look at {100 * overlap.thin:.0f} % of the area")
    for key, title, form in (("points", "points of the sparse model", ",.0f"),
                             ("mean_track_length", "photos that show a point", ".1f"),
                             ("reprojection_error_pixels", "reprojection error, pixels", ".2f")):
        if isinstance(record.get(key), (int, float)):
            yield title, format(record[key], form)


def _residual(survey: Survey) -> str:
    known = survey.georeference
    assert known is not None
    if not known.residual:
        return "not recorded"
    share = f"; the flight extends over {length(survey.size)}" if survey.size else ""
    return f"{length(known.residual)} along the ground, RMS{share}"


def residuals_html(survey: Survey) -> str:
    """The residuals by axis, a table for each role, and those of ground control points."""
    html, note = "", [NOTE]
    for role, meaning in ROLES.items():
        group = [each for each in survey.residuals if each.role == role]
        rows = [(axis, *(_metres(value) for value in (of.mean, of.sigma, of.rms, of.within_90)))
                for axis, of in spreads(group).items()]
        if rows:
            kind = "GPS of photos" if group[0].pixels is None else "ground control points"
            html += f"<h3>Residuals: {kind}, {meaning} ({len(group)})</h3>\n" + Table(
                "", ("", "mean, m", "sigma, m", "RMS, m", "90 % within, m"), rows, range(1, 5),
                note).html()
            note = []
    points = [each for each in survey.residuals if each.pixels is not None]
    if points:
        html += "<h3>Ground control points</h3>\n" + Table(
            "", ("name", "role", "east, m", "north, m", "up, m", "pixels"),
            [(each.name, each.role, *map(_metres, (each.east, each.north, each.up)),
              f"{each.pixels:.1f}") for each in points[:MOST_ROWS]], range(2, 6),
            _more(len(points), "points", "georeference.json")).html()
    return html


def _more(count: int, what: str, file: str) -> tuple[str, ...]:
    return (f"{count - MOST_ROWS:,} more {what} are in {file}.",) if count > MOST_ROWS else ()


def _metres(value: float | None) -> str:
    return "-" if value is None else f"{value:.3f}" if abs(value) < 10 else f"{value:.2f}"


def length(metres: float) -> str:
    """A length for people, such as 4.9 cm or 57 m."""
    _, unit, factor = next(row for row in LENGTHS if metres < row[0])
    return f"{metres * factor:.3g} {unit}" if metres < 1000 else f"{metres:,.0f} m"


def area(square_metres: float) -> str:
    """An area for people, such as 850 m², 1.9 ha or 2.40 km²."""
    for unit, factor in (("m²", 1.0), ("ha", 1e4), ("km²", 1e6)):
        if square_metres < 100 * factor or unit == "km²":
            break
    return f"{square_metres / factor:.3g} {unit}"


def survey_figure(survey: Survey, narrow: bool = False) -> Figure | None:
    """The cameras above the points, coloured by their residual, and the map of overlap."""
    if not np.isfinite(survey.cameras).all():
        return None
    west, east, south, north = _bounds(survey)
    maps = 1 + (survey.overlap is not None)
    beside = 1 if narrow else maps
    width = (NARROW if narrow else WIDE) / (beside if beside > 1 else 1 if narrow else 1.6)
    height = float(np.clip(0.8 * width * (north - south) / (east - west), *HEIGHTS))
    figure = Figure(figsize=(width * beside, height * (maps if narrow else 1) + 0.3),
                    layout="constrained")
    panels = figure.subplots(maps if narrow else 1, beside, squeeze=False).ravel()
    _draw_cameras(figure, panels[0], survey)
    if survey.overlap is not None:
        _draw_overlap(figure, panels[1], survey)
    unit = "m" if survey.georeference is not None else "units of the scene"
    for axes in panels:
        axes.set_xlim(west, east)
        axes.set_ylim(south, north)
        axes.set_aspect("equal")
        axes.grid(False)
        axes.locator_params(nbins=5)
        axes.set_xlabel(f"east, {unit}" if survey.georeference else unit)
    panels[0].set_ylabel(f"north, {unit}" if survey.georeference else unit)
    return figure


def _bounds(survey: Survey) -> tuple[float, float, float, float]:
    """West, east, south and north of all cameras and most points, with some room."""
    shown = [survey.cameras]
    if len(survey.ground):
        shown.append(np.quantile(survey.ground, (0.01, 0.99), axis=0))
    places = np.concatenate(shown)
    low, high = places.min(axis=0), places.max(axis=0)
    room = 0.04 * float((high - low).max()) or 1.0
    (west, south), (east, north) = (low - room).tolist(), (high + room).tolist()
    return west, east, south, north


def _draw_cameras(figure: Figure, axes: Axes, survey: Survey) -> None:
    axes.scatter(survey.ground[:, 0], survey.ground[:, 1], s=1, c="#b9bdc1", linewidths=0,
                 rasterized=True, zorder=1)
    residuals = survey.camera_residuals
    known = residuals[np.isfinite(residuals)]
    colours = matplotlib.colormaps["viridis"].with_extremes(
        bad="white" if len(known) else COLOURS[0])
    dots = axes.scatter(survey.cameras[:, 0], survey.cameras[:, 1], c=residuals, cmap=colours,
                        vmin=0, vmax=max(known, default=1.0), plotnonfinite=True, linewidths=0.4,
                        s=float(np.clip(2000 / len(residuals), 3, 34)), edgecolors="#1d1f21",
                        zorder=3)
    axes.set_title("cameras, by their residual" if len(known) else "cameras")
    if len(known):
        figure.colorbar(dots, ax=axes, label="distance from the GPS, m", shrink=0.8)
    left_out = {each.name for each in survey.residuals if each.role == LEFT_OUT}
    crossed = np.array([name in left_out for name in survey.names])
    if crossed.any():
        axes.plot(*survey.cameras[crossed].T, "x", color=COLOURS[1], markersize=8,
                  markeredgewidth=2, label="GPS left out", zorder=4)
        axes.legend(loc="upper left", frameon=True, framealpha=0.9)


def _draw_overlap(figure: Figure, axes: Axes, survey: Survey) -> None:
    overlap = survey.overlap
    assert overlap is not None
    counts = np.ma.masked_less(overlap.counts, 0)
    west, east, south, north = overlap.bounds
    shown = axes.imshow(counts, origin="lower", extent=(west, east, south, north),
                        cmap="cividis", vmin=0, interpolation="nearest", zorder=1)
    figure.colorbar(shown, ax=axes, label="photos that look at a place", shrink=0.8,
                    ticks=MaxNLocator(6, integer=True))
    axes.set_title("overlap")
