"""How a figure becomes part of a page: from matplotlib's own defaults, whatever a user's settings
say, and as text where it cannot be drawn."""

import base64
import io
import warnings
from contextlib import contextmanager
from html import escape

import matplotlib

SMALL = "#5c6166"
LOOK = {
    "font.size": 10, "axes.titlesize": 10.5, "axes.titleweight": "bold",
    "axes.titlelocation": "left", "axes.spines.top": False, "axes.spines.right": False,
    "axes.edgecolor": "#8b9095", "axes.grid": True, "axes.axisbelow": True,
    "grid.color": "#e8e9ea", "xtick.color": SMALL, "ytick.color": SMALL, "axes.labelcolor": SMALL,
    "axes.linewidth": 0.8, "lines.linewidth": 1.6, "legend.frameon": False,
    "text.parse_math": False,  # names of scenes may have dollar signs
    "svg.hashsalt": "clsplat",  # equal figures, equal bytes
}
PHONE = "(max-width: 40rem)"  # pages no wider than this show the narrow drawing


@contextmanager
def clean_look(**changes):
    """matplotlib with its own defaults and LOOK (`changes` over it), restored afterwards.

    A figure must be made and saved within: some of its text is made when it is saved.
    """
    with matplotlib.rc_context(), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of defaults that are deprecated
        defaults = matplotlib.rcParamsDefault
        matplotlib.rcParams.update({key: defaults[key] for key in defaults if key != "backend"})
        matplotlib.rcParams.update({**LOOK, **changes})
        yield


def drawn(what, draw, *arguments):
    """HTML of a figure, in a wide and a narrow form of which the page shows one.

    what: describes it to who cannot see. draw: called as draw(*arguments, narrow=bool), returns a
    matplotlib Figure, or None where there is nothing to draw: "" then. An error becomes a line.
    """
    try:
        wide, narrow = (_svg(draw, arguments, narrow) for narrow in (False, True))
    except Exception as error:  # noqa: BLE001  (no drawing is worth a page)
        reason = next(iter(str(error).splitlines()), "") or type(error).__name__
        return f"<p class=note>{escape(what)}: could not be drawn ({escape(reason)}).</p>\n"
    if not wide:
        return ""
    return (f'<picture><source media="{PHONE}" srcset="{narrow}">'
            f'<img alt="{escape(what)}" src="{wide}"></picture>\n')


def as_png(draw, *arguments):
    """The bytes of a figure as PNG, in its wide form; None where there is nothing to draw."""
    with clean_look():
        return _saved(draw(*arguments, narrow=False), format="png", dpi=150)


def _svg(draw, arguments, narrow):
    """The address of a figure as SVG, held in itself; None where there is nothing to draw."""
    with clean_look():
        data = _saved(draw(*arguments, narrow=narrow), format="svg", facecolor="none",
                      metadata={"Date": None})
    return data and f"data:image/svg+xml;base64,{base64.b64encode(data).decode()}"


def _saved(figure, **how):
    if figure is None:
        return None
    file = io.BytesIO()
    figure.savefig(file, **how)
    return file.getvalue()
