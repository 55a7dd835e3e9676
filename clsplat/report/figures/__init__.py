"""Figures of matplotlib in one style, whatever a user's settings are: maps, which are PNG files.

This is the only package that imports matplotlib. The end of a training does not wait for it: the
charts of a report are drawn by the page, see `report.charts`.
"""

from contextlib import AbstractContextManager
from typing import Any

import matplotlib
import matplotlib.style
import numpy as np
from matplotlib.colors import Colormap, to_hex

LABEL_COLOUR = "#5c6166"
SETTINGS: dict[str, Any] = {  # of matplotlib
    "font.size": 10,
    "axes.titlesize": 10.5,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": "#8b9095",
    "axes.facecolor": "none",
    "axes.axisbelow": True,
    "xtick.color": LABEL_COLOUR,
    "ytick.color": LABEL_COLOUR,
    "axes.labelcolor": LABEL_COLOUR,
    "axes.linewidth": 0.8,
    "lines.linewidth": 1.6,
    "legend.frameon": False,
    "text.parse_math": False,  # names of scenes may have dollar signs
}


def hex_colours(colours: Colormap | str, count: int) -> list[str]:
    """Colours of a colour map at even steps from its begin to its end, as #rrggbb."""
    return [to_hex(colour) for colour in matplotlib.colormaps.get_cmap(colours)(np.linspace(0, 1, count))]


def own_settings() -> AbstractContextManager[None]:
    """A context of matplotlib's own defaults and SETTINGS.

    A figure must be made and saved within: some of its text is made when it is saved.
    """
    return matplotlib.style.context(["default", SETTINGS])
