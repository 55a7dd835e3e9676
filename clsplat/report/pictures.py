"""The pictures at the beginning of a report: photo, render and error of a few views."""

import base64
from collections.abc import Sequence
from html import escape

import numpy as np
from numpy.typing import NDArray

from clsplat.evaluation.error_map import COLOURS, LARGEST_ERROR
from clsplat.evaluation.pictures import Pictures, ShownView
from clsplat.io.photos.images import encode_jpeg
from clsplat.report.page import Table
from clsplat.report.scores import COLUMNS, EXPLAINED, PERCEPTUAL, number, with_quality

JPEG_QUALITY = 85
# attribute of a ShownView, caption
PANELS = (("photo", "photo"), ("render", "render after the colour fit"), ("error", "its error"))


def pictures_html(pictures: Pictures | None) -> str:
    """The section of a report for its pictures; an error becomes a line of text."""
    if not pictures or not pictures.shown:
        return ""
    try:
        views = "".join(map(_view, pictures.shown))
    except Exception as error:  # noqa: BLE001
        return f"<p class=note>Pictures could not be made ({escape(str(error))}).</p>\n"
    if pictures.held_out:
        title = "Held-out views"
        which = "Photos that the training did not use, beside renders of the same views."
    else:
        title = "Training views"
        which = ("No view is held out, so these photos were trained on, and are a weaker "
                 f"test than others would be. They were chosen from {pictures.count}.")
    colours = ", ".join(f"rgb{colour}" for colour in COLOURS)
    return (f"<h2>{title}</h2>\n<p>{which} PSNR measures how similar the two are after the colour "
            f"fit. {EXPLAINED}</p>\n"
            "<div class=scale><b>error: none</b> "
            f'<i style="background: linear-gradient(to right, {colours})"></i>'
            f"{LARGEST_ERROR:.0%} of full brightness or more</div>\n{views}"
            f"{_numbers(pictures.shown).html()}"
            "<p class=note>The colour fit is a quadratic fit of each render's colours to its "
            "photo; the error is the mean difference of red, green and blue. The PNG files of "
            "<code>clsplat eval</code> have the renders without the fit, too.</p>\n")


def _view(view: ShownView) -> str:
    name, scores = escape(view.scores["name"]), view.scores
    title = {"only": name}.get(view.place, f"{view.place.capitalize()}: {name}")
    panels = "\n".join(
        f"<figure>{jpeg(getattr(view, panel), f'{panel} of {name}')}"
        f"<figcaption>{caption}</figcaption></figure>" for panel, caption in PANELS)
    return (f"<div class=view>\n<h3>{title}</h3>\n"
            f"<p>PSNR {with_quality(scores['psnr_cc'])}</p>\n"
            f"<div class=panels>\n{panels}\n</div>\n</div>\n")


def _numbers(shown: Sequence[ShownView]) -> Table:
    """All scores of the pictures."""
    scores = [view.scores for view in shown]
    columns = [column for column in (*COLUMNS, *PERCEPTUAL) if any(
        column[0] in of_view for of_view in scores)]
    rows = [(str(of_view["name"]), *(number(of_view, key, form) for key, _, form in columns))
            for of_view in scores]
    return Table("", ("view", *(title for _, title, _ in columns)), rows,
                 range(1, len(columns) + 1))


def jpeg(pixels: NDArray[np.uint8], description: str) -> str:
    """HTML of an image [H, W, 3] with an escaped description."""
    height, width = pixels.shape[:2]
    data = base64.b64encode(encode_jpeg(pixels, JPEG_QUALITY)).decode()
    return (f'<img alt="{description}" width={width} height={height} style="height: auto" '
            f'src="data:image/jpeg;base64,{data}">')
