"""Figures of matplotlib in one style, whatever a user's settings are: maps, which are PNG files.

This is the only package that imports matplotlib. The end of a training does not wait for it: the
charts of a report are drawn by the page, see `report.charts`.
"""

import os
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from clsplat.errors import InputError

# matplotlib cannot be imported if this variable names an unknown backend; nothing here opens a
# window, so the choice does not matter
_backend = os.environ.pop("MPLBACKEND", None)
try:
    import matplotlib
except (OSError, ValueError) as error:
    raise InputError(f"matplotlib cannot be imported ({error}); repair or remove its settings, the "
                     "file matplotlibrc, and let it write to the folder that MPLCONFIGDIR names"
                     ) from None
finally:
    if _backend is not None:
        os.environ["MPLBACKEND"] = _backend

LABEL_COLOUR = "#5c6166"
SETTINGS: dict[str, Any] = {  # of matplotlib
    "font.size": 10, "axes.titlesize": 10.5, "axes.titleweight": "bold",
    "axes.titlelocation": "left", "axes.spines.top": False, "axes.spines.right": False,
    "axes.edgecolor": "#8b9095", "axes.facecolor": "none", "axes.axisbelow": True,
    "xtick.color": LABEL_COLOUR, "ytick.color": LABEL_COLOUR, "axes.labelcolor": LABEL_COLOUR,
    "axes.linewidth": 0.8, "lines.linewidth": 1.6, "legend.frameon": False,
    "text.parse_math": False,  # names of scenes may have dollar signs
}
# Okabe and Ito (2008), distinct for the colour-blind; without yellow, which is too pale on white
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#56b4e9", "#e69f00", "#000000")


@contextmanager
def own_settings() -> Iterator[None]:
    """Set matplotlib to its own defaults and SETTINGS, and restore it afterwards.

    A figure must be made and saved within: some of its text is made when it is saved.
    """
    with matplotlib.rc_context(), warnings.catch_warnings():
        warnings.simplefilter("ignore")  # about deprecated defaults
        settings: Any = dict(matplotlib.rcParamsDefault)
        settings.update(SETTINGS)
        del settings["backend"]
        matplotlib.rcParams.update(settings)
        yield
