"""The report of a survey as PDF, of the size A4: facts, maps with legends, and residuals."""

import textwrap
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, BinaryIO
from warnings import catch_warnings, simplefilter

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_pdf import PdfPages
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Colormap, Normalize
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from mpl_toolkits.axes_grid1.anchored_artists import AnchoredSizeBar
from numpy.typing import NDArray

from clsplat.report.figures import LABEL_COLOUR, own_settings
from clsplat.report.page import Table, as_utf8

SIZE = 8.27, 11.69  # inches
LEFT, RIGHT, TOP, BOTTOM = 0.1, 0.92, 0.93, 0.08  # of the page
CHARACTER, LINE = 0.0079, 0.0165  # of the page: a character's mean width, and from line to line
CHARACTERS = int((RIGHT - LEFT) / CHARACTER)
BAR = 0.25  # of the width of a map, at most: a round length of its scale bar
EDGE = 0.03  # of a map, around its dots
DPI = 200
LONGEST = 36  # characters of a cell beside others


@dataclass(frozen=True, eq=False)
class Sheet:
    """A map on a page of its own.

    Attributes
    ----------
    title, note : text above and below it.
    pixels : [H, W, 3 or 4] colours, or [H, W] values of `scale`, the first row in the north.
    bounds : (left, bottom, right, top), map units.
    unit : of lengths.
    north : whether north is at the top.
    scale : the lowest and highest value, the colours and the label of a legend.
    dots : [N, 2], places that are marked.
    """

    title: str
    note: str
    pixels: NDArray[np.generic]
    bounds: tuple[float, float, float, float]
    unit: str
    north: bool
    scale: tuple[float, float, Colormap | str, str] | None = None
    dots: NDArray[np.float64] | None = None


def write_pages(file: BinaryIO, title: str, creator: str, tables: Iterable[Table], sheets: Iterable[Sheet]) -> None:
    """Write a PDF to a binary file: tables, then maps. The same content gives the same bytes.

    Parameters
    ----------
    title : of the first page and of the document.
    creator : the program and its version.
    tables, sheets : the content; empty tables are left out.
    """
    with (
        catch_warnings(),
        own_settings(),
        PdfPages(file, metadata={"Title": as_utf8(title), "Creator": creator, "CreationDate": None}) as pdf,
    ):
        simplefilter("ignore", UserWarning)  # of letters that the font has not, as in names
        for figure in drawn_pages(title, creator, tables, sheets):
            pdf.savefig(figure, dpi=DPI)


def drawn_pages(title: str, creator: str, tables: Iterable[Table], sheets: Iterable[Sheet]) -> list[Figure]:
    """The pages of `write_pages`, whose arguments it has."""
    pages = _Pages()
    pages.write([(LEFT, title)], size=18, weight="bold")
    for table in tables:
        pages.table(table)
    for sheet in sheets:
        _draw(pages.new(), sheet)
    for number, figure in enumerate(pages.figures, 1):
        figure.text(
            LEFT,
            BOTTOM / 2,
            as_utf8(textwrap.shorten(f"{title} · {creator}", CHARACTERS)),
            fontsize=7,
            color=LABEL_COLOUR,
        )
        figure.text(RIGHT, BOTTOM / 2, f"{number} of {len(pages.figures)}", fontsize=7, color=LABEL_COLOUR, ha="right")
    return pages.figures


class _Pages:
    """Pages that text is written on from the top to the bottom."""

    def __init__(self) -> None:
        self.figures: list[Figure] = []
        self.new()

    def new(self) -> Figure:
        """Begin a page."""
        self.figures.append(Figure(figsize=SIZE))
        self._place = TOP
        return self.figures[-1]

    def write(
        self,
        cells: Sequence[tuple[float, str]],
        lines: float = 1,
        size: float = 9,
        align: Sequence[str] = (),
        **style: Any,
    ) -> None:
        """Write a line of cells, each at its place along it, and go down so many lines."""
        height = LINE * lines * size / 9
        if self._place - height < BOTTOM:
            self.new()
        self._place -= height
        for (place, text), side in zip(cells, align or ("left",) * len(cells)):
            self.figures[-1].text(place, self._place, as_utf8(text), fontsize=size, ha=side, **style)

    def table(self, table: Table) -> None:
        """Write a table; the last column of one without numbers is wrapped."""
        if not table.rows:
            return
        if self._place - 6 * LINE < BOTTOM:  # no heading stands alone
            self.new()
        rows = [
            [*(textwrap.shorten(cell, LONGEST, placeholder="...") for cell in row[:-1]), row[-1]]
            for row in (table.head, *table.rows)
        ]
        width = [max(len(row[column]) for row in rows) + 3 for column in range(len(table.head))]
        ends = LEFT + CHARACTER * np.cumsum(width)
        align = ["right" if column in table.numbers else "left" for column in range(len(width))]
        places = [
            end - 3 * CHARACTER if side == "right" else end - CHARACTER * size
            for end, side, size in zip(ends, align, width)
        ]
        room = CHARACTERS - sum(width[:-1])
        self.write([], 1)
        self.write([(LEFT, table.title)], 1.3, size=11, weight="bold")
        for number, row in enumerate(rows):
            if not any(row):
                continue
            wrapped = [row[-1]] if table.numbers else textwrap.wrap(row[-1], room) or [""]
            self.write(
                list(zip(places, (*row[:-1], wrapped[0]))), align=align, color=LABEL_COLOUR if number == 0 else "black"
            )
            for rest in wrapped[1:]:
                self.write([(places[-1], rest)])
        for note in table.notes:
            for line in textwrap.wrap(note, CHARACTERS):
                self.write([(LEFT, line)], size=8, color=LABEL_COLOUR)


def _draw(figure: Figure, sheet: Sheet) -> None:
    """A map with its title, coordinates, scale bar, north arrow and legend."""
    left, bottom, right, top = sheet.bounds
    figure.text(LEFT, TOP - LINE, sheet.title, fontsize=14, weight="bold")
    for number, line in enumerate(textwrap.wrap(sheet.note, CHARACTERS)):
        figure.text(LEFT, TOP - (2.2 + number) * LINE, line, fontsize=9, color=LABEL_COLOUR)
    axes = figure.add_axes((LEFT + 0.03, 0.2, RIGHT - LEFT - 0.03, 0.66), anchor="N")
    *ends, colours, label = sheet.scale or (0, 1, None, "")
    norm, is_values = Normalize(*ends), sheet.pixels.ndim == 2
    axes.imshow(
        np.ma.masked_invalid(sheet.pixels) if is_values else sheet.pixels,
        extent=(left, right, bottom, top),
        interpolation="none",
        norm=norm,
        cmap=colours,
    )
    if sheet.dots is not None:
        axes.plot(
            *sheet.dots.T,
            "o",
            color="white",
            markeredgecolor="black",
            markersize=3,
            markeredgewidth=0.6,
            linestyle="none",
        )
        places = np.concatenate([sheet.dots, [(left, bottom), (right, top)]])
        room = EDGE * np.ptp(places, axis=0)
        low, high = places.min(axis=0) - room, places.max(axis=0) + room
        axes.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]))
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(MaxNLocator(4))
        axis.set_major_formatter("{x:,.6g}" if abs(right - left) < 10 else "{x:,.0f}")
    axes.tick_params(labelsize=7)
    axes.tick_params("y", rotation=90)
    axes.grid(True, linewidth=0.3, alpha=0.5)
    axes.set_xlabel(f"east, {sheet.unit}" if sheet.north else sheet.unit, fontsize=8)
    axes.set_ylabel(f"north, {sheet.unit}" if sheet.north else sheet.unit, fontsize=8)
    _scale_and_north(axes, sheet)
    if sheet.scale:
        bar = figure.add_axes((LEFT + 0.15, 0.12, 0.55, 0.014))
        figure.colorbar(
            ScalarMappable(norm, colours),
            cax=bar,
            orientation="horizontal",
            extend="both" if not is_values else "neither",
        ).set_label(label, fontsize=9)
        bar.tick_params(labelsize=8)


def _scale_and_north(axes: Axes, sheet: Sheet) -> None:
    """A bar of a round length at the lower left, and an arrow at the upper right."""
    low, high = axes.get_xlim()
    power = 10.0 ** np.floor(np.log10(BAR * (high - low)))
    size = power * max(each for each in (1, 2, 5) if each * power <= BAR * (high - low))
    axes.add_artist(
        AnchoredSizeBar(
            axes.transData,
            float(size),
            f"{size:,g} {sheet.unit}",
            "lower left",
            pad=0.4,
            borderpad=0.5,
            sep=3,
            size_vertical=0.006 * (high - low) * 0.8,
        )
    )
    if sheet.north:
        axes.annotate(
            "N",
            (0.95, 0.985),
            (0.95, 0.90),
            "axes fraction",
            ha="center",
            va="center",
            fontsize=10,
            weight="bold",
            arrowprops={"arrowstyle": "-|>", "color": "black", "linewidth": 1.5},
            bbox={"boxstyle": "circle,pad=0.2", "color": "white", "alpha": 0.8},
        )
