"""Figures as parts of a page.

They are drawn from matplotlib's own defaults, whatever a user's settings are. A figure that cannot
be drawn becomes a line of text.
"""

import base64
import io
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from html import escape
from typing import Any

import matplotlib
from matplotlib.figure import Figure

LABEL_COLOUR = "#5c6166"
SETTINGS: dict[str, Any] = {  # of matplotlib
    "font.size": 10, "axes.titlesize": 10.5, "axes.titleweight": "bold",
    "axes.titlelocation": "left", "axes.spines.top": False, "axes.spines.right": False,
    "axes.edgecolor": "#8b9095", "axes.facecolor": "none", "axes.grid": True,
    "axes.axisbelow": True, "grid.color": "#e8e9ea", "xtick.color": LABEL_COLOUR,
    "ytick.color": LABEL_COLOUR, "axes.labelcolor": LABEL_COLOUR, "axes.linewidth": 0.8,
    "lines.linewidth": 1.6,
    "legend.frameon": False,
    "text.parse_math": False,  # names of scenes may have dollar signs
    "svg.hashsalt": "clsplat",  # equal figures, equal bytes
}
PHONE = "(max-width: 40rem)"  # pages no wider than this show the narrow drawing


@contextmanager
def own_settings(**changes: Any) -> Iterator[None]:
    """Set matplotlib to its own defaults, SETTINGS and `changes`, and restore it afterwards.

    A figure must be made and saved within: some of its text is made when it is saved.
    """
    with matplotlib.rc_context(), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # about deprecated defaults
        settings: Any = dict(matplotlib.rcParamsDefault)
        settings.update(SETTINGS, **changes)
        del settings["backend"]
        matplotlib.rcParams.update(settings)
        yield


def drawn(description: str, draw: Callable[..., Figure | None], *arguments: object) -> str:
    """HTML of a figure, in a wide and a narrow form of which the page shows one.

    Parameters
    ----------
    description : the text for readers who cannot see the figure.
    draw : called as draw(*arguments, narrow=bool); returns None if there is nothing to draw.

    Returns
    -------
    The HTML, "" if there is nothing to draw, or a line of text after an error.
    """
    try:
        wide, narrow = (_svg(draw, arguments, narrow) for narrow in (False, True))
    except Exception as error:  # noqa: BLE001  (no drawing is worth a page)
        reason = next(iter(str(error).splitlines()), "") or type(error).__name__
        return f"<p class=note>{escape(description)}: could not be drawn ({escape(reason)}).</p>\n"
    if not wide:
        return ""
    return (f'<picture><source media="{PHONE}" srcset="{narrow}">'
            f'<img alt="{escape(description)}" src="{wide}"></picture>\n')


def as_png(draw: Callable[..., Figure | None], *arguments: object) -> bytes | None:
    """The wide form of a figure as PNG; None where there is nothing to draw."""
    with own_settings():
        return _saved(draw(*arguments, narrow=False), format="png", dpi=150)


def _svg(draw: Callable[..., Figure | None], arguments: tuple[object, ...], narrow: bool
         ) -> str | None:
    """A data URL with a figure as SVG; None where there is nothing to draw."""
    with own_settings():
        data = _saved(draw(*arguments, narrow=narrow), format="svg", facecolor="none",
                      metadata={"Date": None})
    return f"data:image/svg+xml;base64,{base64.b64encode(data).decode()}" if data else None


def _saved(figure: Figure | None, **settings: Any) -> bytes | None:
    if figure is None:
        return None
    file = io.BytesIO()
    figure.savefig(file, **settings)
    return file.getvalue()
