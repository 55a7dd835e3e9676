"""The files of a map, and what they are for; and the styles of its rasters."""

from collections.abc import Mapping
from pathlib import Path

from clsplat.apps.geotiff import Raster
from clsplat.apps.qgis import SUFFIX, write_greys, write_heights_style
from clsplat.apps.stac import COG, GEOJSON, PDF, PNG, XML, Asset

ORTHOPHOTO, SURFACE, TERRAIN = "orthophoto.tif", "surface.tif", "terrain.tif"
SHADING = {SURFACE: "hillshade.tif", TERRAIN: "terrain_hillshade.tif"}
STYLES = {name: Path(name).with_suffix(SUFFIX).name for name in (*SHADING, *SHADING.values())}
CONTOURS, PREVIEW, ITEM = "contours.geojson", "preview.png", "item.json"
REPORT, RECORD = "survey.pdf", "map.json"
ASSETS: dict[str, Asset] = {
    ORTHOPHOTO: (COG, "visual", "Orthophoto"),
    SURFACE: (COG, "data", "Surface with houses and trees"),
    TERRAIN: (COG, "data", "Ground without houses and trees"),
    SHADING[SURFACE]: (COG, "visual", "Hillshade of the surface"),
    SHADING[TERRAIN]: (COG, "visual", "Hillshade of the ground"),
    **{style: (XML, "metadata", f"Style of {name} for QGIS") for name, style in STYLES.items()},
    CONTOURS: (GEOJSON, "data", "Contour lines"),
    PREVIEW: (PNG, "overview", "Orthophoto and surface"),
    REPORT: (PDF, "metadata", "Report of the survey"),
}
FILES = *ASSETS, ITEM, RECORD


def write_styles(folder: Path, rasters: Mapping[str, Raster], level: int, unit: str) -> list[str]:
    """Write the styles of rasters, by the heights of a level of theirs; the names of the files."""
    for name, shading in SHADING.items():
        if name in rasters:
            write_heights_style(folder / name, rasters[name].whole(level)[..., 0], unit)
            write_greys(folder / shading, 1, 255)
    return [STYLES[name] for name in rasters if name in STYLES]
