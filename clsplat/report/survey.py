"""The section "Survey" of a report: maps of the cameras and of the overlap, and the errors."""

import base64
from collections.abc import Iterator
from dataclasses import replace
from html import escape

import numpy as np
from numpy.typing import NDArray

from clsplat.evaluation.survey import Survey, record_of, spreads, survey_of, vertical_reference
from clsplat.georeference import CHECK, CONTROL, LEFT_OUT
from clsplat.io.photos.images import encode_image
from clsplat.report.page import Table, folded, headed, warning
from clsplat.scene import Scene

SHOWN = 5  # names in a sentence
ROLES = {CONTROL: "which decided the place", CHECK: "which took no part"}
NOTE = "From the measured place to that in the scene. 90 % within: along the ground it is called CE90, and up LE90."
RECORDED = (
    ("points", "points of the sparse model", ",.0f"),
    ("mean_track_length", "photos that show a point", ".1f"),
    ("reprojection_error_pixels", "reprojection error, pixels", ".2f"),
)
# matplotlib's "viridis", at each quarter
RAMP = np.array([(68, 1, 84), (59, 82, 139), (33, 145, 140), (94, 201, 98), (253, 231, 37)])
GREY, NO_RESIDUAL, RING = (150, 155, 160), "#0072b2", "#d55e00"
CELLS = 400  # of the longer side of the picture of the points
WIDTH = 460  # pixels, about, of the longer side of a map: decides how large its dots are


def survey_html(scene: Scene | None) -> str:
    """The section of a report for a scene at the size of its photos; "" if it is no survey. An
    error becomes a line of text."""
    try:
        is_survey = scene and (scene.georeference or record_of(scene))
        return _section(survey_of(scene)) if scene and is_survey else ""
    except Exception as error:  # noqa: BLE001  (no survey is worth a page)
        return f"<p class=note>The survey could not be shown ({escape(str(error))}).</p>\n"


def _section(survey: Survey) -> str:
    missing = list(survey.record.get("not_registered", {}).items())
    unused = Table("", ("photo", "reason"), missing)
    return headed(
        "Survey",
        *(warning(f"Warning: {text}") for text in warnings(survey)),
        Table("", ("", ""), list(facts(survey))),
        survey_maps(survey),
        *(f"<h3>{escape(table.title)}</h3>\n" + replace(table, title="").html() for table in residual_tables(survey)),
        folded("Photos that were not used", unused.html()) if missing else "",
    )


def warnings(survey: Survey) -> tuple[str, ...]:
    """Sentences that the reader must not miss: those of the georeference and of `clsplat sfm`."""
    known = survey.georeference
    return tuple(dict.fromkeys((*(known.warnings if known else ()), *survey.record.get("warnings", ()))))


def facts(survey: Survey) -> Iterator[tuple[str, str]]:
    """A row for each fact that is known."""
    known, overlap = survey.georeference, survey.overlap
    used, given = len(survey.names), survey.record.get("photos")
    yield "photos used", f"{used:,} of {given:,}" if given else f"{used:,}"
    if known is None:
        yield "georeference", "none, so sizes are not known in metres"
    else:
        yield "georeference", f"{known.crs[:60]}, by the {known.source or 'files of the scene'}"
        yield "heights", vertical_reference(known)
        share = f"; the flight extends over {length(known.size)}" if known.size else ""
        yield (
            "residual",
            (f"{length(known.residual)} along the ground, RMS{share}" if known.residual else "not recorded"),
        )
        if left_out := known.names(LEFT_OUT):
            rest = f" and {len(left_out) - SHOWN} more" if len(left_out) > SHOWN else ""
            yield "left out", f"{', '.join(left_out[:SHOWN])}{rest}, which contradict the others"
        if survey.pixel:
            yield "ground sampling distance", f"{length(survey.pixel)} a pixel of the photos"
        if survey.height:
            yield "distance of the ground", f"{length(survey.height)} from the cameras, median"
        if overlap is not None:
            yield "area covered", f"{area(overlap.covered)}, by at least two photos"
    if overlap is not None:
        yield (
            "overlap",
            (
                f"{overlap.mean:.1f} photos look at a place, in the mean; fewer than "
                f"three look at {100 * overlap.thin:.0f} % of the area"
            ),
        )
    if priors := survey.record.get("position_priors"):
        yield "positions as priors", priors["text"]
    for key, title, form in RECORDED:
        if survey.record.get(key) is not None:
            yield title, format(survey.record[key], form)


def survey_maps(survey: Survey) -> str:
    """HTML of the cameras above the points, coloured by their residual, and of the overlap; "" if
    the places are not known."""
    if not np.isfinite(survey.cameras).all():
        return ""
    shown = [survey.cameras]
    if len(survey.ground):
        shown.append(np.quantile(survey.ground, (0.01, 0.99), axis=0))
    places = np.concatenate(shown)
    low, high = places.min(axis=0), places.max(axis=0)
    room = 0.04 * float((high - low).max()) or 1.0
    low, high = low - room, high + room
    residuals = survey.camera_residuals
    known = residuals[np.isfinite(residuals)]
    maps = [
        _map(
            "cameras, by their residual" if len(known) else "cameras",
            low,
            high,
            _points(survey, low, high) + _cameras(survey, low, high, max(known, default=1.0)),
            survey,
        )
        + (_ramp(f"{max(known):.2g} m from the GPS") if len(known) else "")
    ]
    if survey.overlap is not None:
        counts, (west, east, south, north) = survey.overlap.counts, survey.overlap.bounds
        pixels = np.dstack([_colours(counts / max(counts.max(), 1)), 255 * (counts >= 0)])
        maps.append(
            _map("overlap", low, high, _image(pixels, (west, south), (east, north), low), survey)
            + _ramp(f"{counts.max()} photos that look at a place")
        )
    pair = " pair" if len(maps) > 1 else ""
    return (
        f'<div class="maps{pair}" role=img aria-label="Map of the '
        f'{len(survey.names)} cameras, and how many photos look at each place">'
        + "".join(f"<div>{each}</div>" for each in maps)
        + "</div>\n"
    )


def _map(title: str, low: NDArray[np.float64], high: NDArray[np.float64], content: str, survey: Survey) -> str:
    """An SVG of the area between two corners, with its size; `content` is in map units from `low`,
    with y to the north."""
    width, height = high - low
    size = (
        f"{length(width)} x {length(height)}, north is upwards"
        if survey.georeference
        else f"{width:.3g} x {height:.3g} units of the scene"
    )
    return (
        f"<h4>{title}</h4>\n<p class=note>{size}</p>\n"
        f'<svg viewBox="0 0 {width:.6g} {height:.6g}">'
        f'<g transform="translate(0 {height:.6g}) scale(1 -1)">{content}</g></svg>\n'
    )


def _points(survey: Survey, low: NDArray[np.float64], high: NDArray[np.float64]) -> str:
    """The points of the ground as an image."""
    cell = (high - low).max() / CELLS
    columns, rows = np.ceil((high - low) / cell).astype(int).tolist()
    found, _, _ = np.histogram2d(
        survey.ground[:, 1] - low[1],
        survey.ground[:, 0] - low[0],
        (rows, columns),
        ((0, rows * cell), (0, columns * cell)),
    )
    pixels = np.empty((rows, columns, 4))
    pixels[:] = (*GREY, 0)
    pixels[..., 3] = 255 * (found > 0)
    return _image(pixels, (0, 0), (columns * cell, rows * cell), np.zeros(2))


def _cameras(survey: Survey, low: NDArray[np.float64], high: NDArray[np.float64], most: float) -> str:
    """A dot at each camera, with its name and residual, in a ring where GPS was left out."""
    size = float(np.clip(30 / len(survey.names) ** 0.5, 1.2, 5) * (high - low).max() / WIDTH)
    left_out = {each.name for each in survey.residuals if each.role == LEFT_OUT}
    shapes = []
    for name, (x, y), residual in zip(survey.names, survey.cameras - low, survey.camera_residuals):
        known = np.isfinite(residual)
        colour = "rgb({:.0f} {:.0f} {:.0f})".format(*_colours(np.array(residual / most))) if known else NO_RESIDUAL
        text = escape(f"{name}, {residual:.2g} m from its GPS" if known else name)
        ring = f' stroke="{RING}" stroke-width="{size:.4g}"' if name in left_out else ""
        shapes.append(
            f'<circle cx="{x:.6g}" cy="{y:.6g}" r="{size:.4g}" fill="{colour}"{ring}>'
            f"<title>{text}{', left out' if ring else ''}</title></circle>"
        )
    return "".join(shapes)


def _image(
    pixels: NDArray[np.floating], low: tuple[float, float], high: tuple[float, float], origin: NDArray[np.float64]
) -> str:
    """An image [H, W, 4] from south to north between two corners."""
    data = encode_image(pixels.astype(np.uint8), "png", 0, "map")
    return (
        f'<image x="{low[0] - origin[0]:.6g}" y="{low[1] - origin[1]:.6g}" '
        f'width="{high[0] - low[0]:.6g}" height="{high[1] - low[1]:.6g}" '
        'preserveAspectRatio="none" style="image-rendering: pixelated" '
        f'href="data:image/png;base64,{base64.b64encode(data).decode()}"/>'
    )


def _colours(shares: NDArray[np.floating]) -> NDArray[np.float64]:
    """The colour of each share of the largest value, [..., 3]."""
    places = np.linspace(0, 1, len(RAMP))
    return np.stack([np.interp(shares, places, RAMP[:, channel]) for channel in range(3)], axis=-1)


def _ramp(most: str) -> str:
    colours = ", ".join(f"rgb({red} {green} {blue})" for red, green, blue in RAMP)
    return f'<p class=scale><b>0</b> <i style="background: linear-gradient(to right, {colours})"></i>{most}</p>\n'


def residual_tables(survey: Survey) -> list[Table]:
    """The residuals by axis, a table for each role, and those of ground control points."""
    tables = list[Table]()
    for role, meaning in ROLES.items():
        group = [each for each in survey.residuals if each.role == role]
        rows = [
            (axis, *(_metres(value) for value in (of.mean, of.sigma, of.rms, of.within_90)))
            for axis, of in spreads(group).items()
        ]
        if rows:
            kind = "GPS of photos" if group[0].pixels is None else "ground control points"
            tables.append(
                Table(
                    f"Residuals: {kind}, {meaning} ({len(group)})",
                    ("", "mean, m", "sigma, m", "RMS, m", "90 % within, m"),
                    rows,
                    range(1, 5),
                    () if tables else (NOTE,),
                )
            )
    points = [each for each in survey.residuals if each.pixels is not None]
    if points:
        tables.append(
            Table(
                "Ground control points",
                ("name", "role", "east, m", "north, m", "up, m", "pixels"),
                [
                    (each.name, each.role, *map(_metres, (each.east, each.north, each.up)), f"{each.pixels:.1f}")
                    for each in points
                ],
                range(2, 6),
            )
        )
    return tables


def _metres(value: float | None) -> str:
    return "-" if value is None else f"{value:.3f}" if abs(value) < 10 else f"{value:.2f}"


def length(metres: float) -> str:
    """A length for people, such as 4.9 cm or 57 m."""
    if metres >= 1000:
        return f"{metres:,.0f} m"
    unit, factor = ("mm", 1e3) if metres < 0.01 else ("cm", 1e2) if metres < 1 else ("m", 1.0)
    return f"{metres * factor:.3g} {unit}"


def area(square_metres: float) -> str:
    """An area for people, such as 850 m² or 1.94 ha."""
    return f"{square_metres:.3g} m²" if square_metres < 1000 else f"{square_metres / 1e4:,.4g} ha"
