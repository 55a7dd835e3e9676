"""The pictures that a report begins with: photo, render and error of a few views."""

import base64
from html import escape

from clsplat.evaluation.error_map import COLOURS, LARGEST_ERROR
from clsplat.io.images import encode_jpeg

QUALITY = 85  # of JPEG
# comments around the pictures in a page, where `renew` finds them again
BEGIN, END = "<!-- pictures -->\n", "<!-- end of pictures -->\n"
# attribute of a ShownView, caption
PANELS = (("photo", "photo"), ("render", "render after the colour fit"), ("error", "its error"))


def pictures_html(pictures):
    """The section of a report for Pictures of `evaluation/pictures.py`; None: one without any.

    An error becomes a line: no picture is worth a page.
    """
    return f"{BEGIN}{_section(pictures)}{END}"


def with_pictures(html, pictures):
    """A page with its section of pictures replaced; None where it has no such section."""
    before, begin, rest = html.partition(BEGIN)
    _, end, after = rest.partition(END)
    return f"{before}{pictures_html(pictures)}{after}" if begin and end else None


def _section(pictures):
    if not pictures or not pictures.shown:
        return ""
    try:
        views = "".join(map(_view, pictures.shown))
    except Exception as error:  # noqa: BLE001
        return f"<p class=note>Pictures could not be made ({escape(str(error))}).</p>\n"
    if pictures.held_out:
        title = "Held-out views"
        which = "Photos that the training did not use, beside what the model shows from there."
    else:
        title = "Training views"
        which = ("No view is held out, so these photos were trained on: they say less about the "
                 f"model than others would. Chosen from {pictures.count} of them.")
    colours = ", ".join(f"rgb{colour}" for colour in COLOURS)
    return (f"<h2>{title}</h2>\n<p>{which} PSNR and SSIM are higher where both are more alike."
            "</p>\n<div class=scale><b>error: none</b> "
            f'<i style="background: linear-gradient(to right, {colours})"></i>'
            f"{LARGEST_ERROR:.0%} of full brightness or more</div>\n{views}"
            "<p class=note>The colour fit is a quadratic fit of each render's colours to its "
            "photo; the error is the mean difference of red, green and blue. The PNG files of "
            "`clsplat eval` have the renders without the fit, too.</p>\n")


def _view(view):
    name, scores = escape(view.scores["name"]), view.scores
    title = {"only": name}.get(view.place, f"{view.place.capitalize()}: {name}")
    panels = "\n".join(
        f"<figure>{_jpeg(getattr(view, panel), f'{panel} of {name}')}"
        f"<figcaption>{caption}</figcaption></figure>" for panel, caption in PANELS)
    return (f"<div class=view>\n<h3>{title}</h3>\n"
            f"<p>PSNR {scores['psnr_cc']:.2f} dB, SSIM {scores['ssim_cc']:.3f} after the colour "
            f"fit ({scores['psnr']:.2f} dB, {scores['ssim']:.3f} plain)</p>\n"
            f"<div class=panels>\n{panels}\n</div>\n</div>\n")


def _jpeg(pixels, what):
    """HTML of pixels uint8[H, W, 3]; what: escaped text."""
    height, width = pixels.shape[:2]
    data = base64.b64encode(encode_jpeg(pixels, QUALITY)).decode()
    return (f'<img alt="{what}" width={width} height={height} style="height: auto" '
            f'src="data:image/jpeg;base64,{data}">')
