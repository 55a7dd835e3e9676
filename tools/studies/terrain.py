"""How true the surface and the terrain of a map of a made city are.

    clsplat map RUN -o MAP --terrain 10
    python -m tools.studies.terrain MAP SCENE

prints one line of JSON, of the area that the city is built on, in metres. `ground_right` and
`building_right` are the shares of the pixels of each that the terrain has as such.
"""

import argparse
import json
from pathlib import Path

import numpy as np
import rasterio

from clsplat.apps.map_files import SURFACE, TERRAIN
from tools.synth.city import KINDS, UNIT_METRES, from_above, read_city


def errors_of(values):
    """Absolute errors in metres: median, 95 % and root mean square."""
    found = UNIT_METRES * np.abs(values)
    return {
        "median": float(np.median(found)),
        "p95": float(np.quantile(found, 0.95)),
        "rms": float(np.sqrt(np.mean(found**2))),
    }


def compared(folder, city):
    """The scores of the map in a folder."""
    with rasterio.open(folder / SURFACE) as file:
        surface, place = file.read(1), file.transform
    with rasterio.open(folder / TERRAIN) as file:
        terrain, ground = file.read()
    rows, columns = np.indices(surface.shape)
    x, y = place.c + (columns + 0.5) * place.a, place.f + (rows + 0.5) * place.e
    heights, solids = from_above(city, x, y)
    used = np.isfinite(surface) & (np.abs(x) < city.extent[0]) & (np.abs(y) < city.extent[1])
    buildings = np.isin(solids, 1 + np.flatnonzero(city.kinds == KINDS.index("building")))
    return {
        "pixel": place.a * UNIT_METRES,
        "surface": errors_of((surface - heights)[used]),
        "terrain": errors_of(terrain[used]),
        "beneath_buildings": errors_of(terrain[used & buildings]),
        "ground_right": float((ground > 0)[used & (solids == 0)].mean()),
        "building_right": float((ground == 0)[used & buildings].mean()),
    }


def main():
    """Print the scores of a map."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("map", type=Path)
    parser.add_argument("scene", type=Path, help="the made city")
    given = parser.parse_args()
    print(json.dumps(compared(given.map, read_city(given.scene / "geometry.json"))))


if __name__ == "__main__":
    main()
