"""The section "Survey" of a report: maps of the cameras and of the overlap, and the errors."""

from __future__ import annotations

from collections.abc import Iterator
from html import escape

from clsplat.evaluation.survey import Survey, spreads, survey_of
from clsplat.georeference import CHECK, CONTROL
from clsplat.report.charts import drawn, survey_figure
from clsplat.report.page import Table, folded, headed, warning
from clsplat.scene import Scene

MOST_ROWS = 60  # of a table; more points than these are named by no one
SHOWN = 5  # names in a sentence
ROLES = {CONTROL: "which decided the place", CHECK: "which took no part"}
NOTE = ("From the measured place to that in the scene. 90 % within: along the ground it is called "
        "CE90, and up LE90.")
RECORDED = (("points", "points of the sparse model", ",.0f"),
            ("mean_track_length", "photos that show a point", ".1f"),
            ("reprojection_error_pixels", "reprojection error, pixels", ".2f"))


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
    listed = survey.record.get("not_registered")
    missing = [(str(name), str(why)) for name, why in listed.items()] if isinstance(
        listed, dict) else []
    unused = Table("", ("photo", "reason"), missing[:MOST_ROWS],
                   notes=_more(len(missing), "photos", "sfm.json"))
    return headed(
        "Survey", *(warning(f"Warning: {text}") for text in warnings(survey)), facts_table(survey),
        maps and f"<div class=plate>{maps}</div>\n",  # its colours stay as they are
        _residuals_html(survey),
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
    known, overlap = survey.georeference, survey.overlap
    used, given = len(survey.names), survey.record.get("photos")
    yield "photos used", f"{used:,} of {given:,}" if isinstance(given, int) else f"{used:,}"
    if known is None:
        yield "georeference", "none, so sizes are not known in metres"
    else:
        yield "georeference", f"{known.crs[:60]}, by the {known.source or 'files of the scene'}"
        if known.vertical:
            yield "heights", known.vertical
        share = f"; the flight extends over {length(survey.size)}" if survey.size else ""
        yield "residual", (f"{length(known.residual)} along the ground, RMS{share}"
                           if known.residual else "not recorded")
        if left_out := survey.left_out:
            rest = f" and {len(left_out) - SHOWN} more" if len(left_out) > SHOWN else ""
            yield "left out", f"{', '.join(left_out[:SHOWN])}{rest}, which contradict the others"
        if survey.pixel:
            yield "ground sampling distance", f"{length(survey.pixel)} a pixel of the photos"
        if survey.height:
            yield "distance of the ground", f"{length(survey.height)} from the cameras, median"
        if overlap is not None:
            yield "area covered", f"{area(overlap.covered)}, by at least two photos"
    if overlap is not None:
        yield "overlap", (f"{overlap.mean:.1f} photos look at a place, in the mean; fewer than "
                          f"three look at {100 * overlap.thin:.0f} % of the area")
    for key, title, form in RECORDED:
        if isinstance(survey.record.get(key), (int, float)):
            yield title, format(survey.record[key], form)


def _residuals_html(survey: Survey) -> str:
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
    if metres >= 1000:
        return f"{metres:,.0f} m"
    unit, factor = ("mm", 1e3) if metres < 0.01 else ("cm", 1e2) if metres < 1 else ("m", 1.0)
    return f"{metres * factor:.3g} {unit}"


def area(square_metres: float) -> str:
    """An area for people, such as 850 m², 1.9 ha or 2.40 km²."""
    for unit, factor in (("m²", 1.0), ("ha", 1e4), ("km²", 1e6)):
        if square_metres < 100 * factor or unit == "km²":
            break
    return f"{square_metres / factor:.3g} {unit}"
