"""Styles of QGIS 3: .qml files beside GeoTIFF files, which QGIS applies when it opens these."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from xml.etree.ElementTree import Element, SubElement, indent, tostring

import numpy as np
from numpy.typing import NDArray

from clsplat.io.atomic import replacing
from clsplat.report.figures import hex_colours
from clsplat.report.figures.map_preview import TINTS, USUAL

HEAD = b"<!DOCTYPE qgis PUBLIC 'http://mrcc.com/qgis.dtd' 'SYSTEM'>\n"
SUFFIX = ".qml"
STOPS = 5  # colours of a ramp


def write_ramp(raster: Path, colours: Sequence[str], low: float, high: float, unit: str) -> None:
    """Write the style of a GeoTIFF whose first band is shown by a colour ramp with a legend.

    Parameters
    ----------
    raster : the GeoTIFF.
    colours : as #rrggbb, at even steps from the lowest value to the highest.
    low, high : values; what is beyond has the colours of these.
    unit : of the values, for the legend.
    """
    ends = {"classificationMin": repr(low), "classificationMax": repr(high)}
    renderer, style = _style("singlebandpseudocolor", {"band": "1", **ends})
    shader = SubElement(
        SubElement(renderer, "rastershader"),
        "colorrampshader",
        colorRampType="INTERPOLATED",
        classificationMode="1",
        clip="0",
        minimumValue=repr(low),
        maximumValue=repr(high),
    )
    SubElement(
        SubElement(SubElement(shader, "colorramp", type="gradient", name="[source]"), "Option", type="Map"),
        "Option",
        type="QString",
        name="rampType",
        value="gradient",
    )
    for value, colour in zip(np.linspace(low, high, len(colours)).tolist(), colours):
        SubElement(shader, "item", value=repr(value), color=colour, alpha="255", label=f"{value:.2f} {unit}")
    _write(raster, style)


def write_heights_style(raster: Path, heights: NDArray[np.floating], unit: str) -> None:
    """Write the style of a GeoTIFF whose first band has these heights, nan: unknown, in the colours
    of the other pictures of heights."""
    low, high = np.nanquantile(heights, USUAL).tolist()
    write_ramp(raster, hex_colours(TINTS, STOPS), low, max(high, low + 1e-9), unit)


def write_greys(raster: Path, low: int, high: int) -> None:
    """Write the style of a GeoTIFF whose first band is grey: `low` black and `high` white."""
    renderer, style = _style("singlebandgray", {"grayBand": "1", "gradient": "BlackToWhite"})
    contrast = SubElement(renderer, "contrastEnhancement")
    for name, value in (("minValue", low), ("maxValue", high), ("algorithm", "StretchToMinimumMaximum")):
        SubElement(contrast, name).text = str(value)
    _write(raster, style)


def _style(kind: str, attributes: Mapping[str, str]) -> tuple[Element, Element]:
    """A renderer, and the style around it."""
    style = Element("qgis", version="3.22.0", styleCategories="Symbology")
    renderer = SubElement(
        SubElement(style, "pipe"), "rasterrenderer", {"type": kind, "opacity": "1", "alphaBand": "-1", **attributes}
    )
    return renderer, style


def _write(raster: Path, style: Element) -> None:
    indent(style)
    with replacing(raster.with_suffix(SUFFIX)) as file:
        file.write(HEAD + tostring(style))
