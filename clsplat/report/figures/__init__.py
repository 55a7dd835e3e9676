"""Figures of matplotlib in one style, whatever a user's settings are: maps, which are PNG files.

This is the only package that imports matplotlib. The end of a training does not wait for it: the
charts of a report are drawn by the page, see `report.charts`.
"""

from contextlib import AbstractContextManager
from typing import Any

import matplotlib.style

LABEL_COLOUR = "#5c6166"
SETTINGS: dict[str, Any] = {  # of matplotlib
    "font.size": 10, "axes.titlesize": 10.5, "axes.titleweight": "bold",
    "axes.titlelocation": "left", "axes.spines.top": False, "axes.spines.right": False,
    "axes.edgecolor": "#8b9095", "axes.facecolor": "none", "axes.axisbelow": True,
    "xtick.color": LABEL_COLOUR, "ytick.color": LABEL_COLOUR, "axes.labelcolor": LABEL_COLOUR,
    "axes.linewidth": 0.8, "lines.linewidth": 1.6, "legend.frameon": False,
    "text.parse_math": False,  # names of scenes may have dollar signs
}


def own_settings() -> AbstractContextManager[None]:
    """A context of matplotlib's own defaults and SETTINGS.

    A figure must be made and saved within: some of its text is made when it is saved.
    """
    return matplotlib.style.context(["default", SETTINGS])
