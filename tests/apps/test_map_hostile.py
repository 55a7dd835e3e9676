"""Words of `clsplat map` that no one should give, or that few do: each is refused in one line, or
drawn right."""

import dataclasses
import json

import numpy as np
import pytest
import rasterio
from click.testing import CliRunner

from clsplat.cli.main import main
from clsplat.evaluation.run import Run
from clsplat.georeference import Residual
from clsplat.io.georeference.crs import normal_crs
from tests.apps.test_map import run_of
from tests.data import ground_model as made

COMPOUND = "EPSG:32633+5773"
MIDDLE = made.OFFSET + made.UTM.offset
NEAR = tuple(str(side) for side in (MIDDLE[0] - 4, MIDDLE[1] - 4, MIDDLE[0] + 4, MIDDLE[1] + 4))
REFUSED = [
    (["--resolution", "1e5"], "larger than the map"),
    (["--resolution", "1e-300"], "pixels along a side"),
    (["--resolution", "0"], "range"),
    (["--resolution", "nan"], "not a finite number"),
    (["--bounds", "nan", "0", "1", "1"], "--bounds"),
    (["--bounds", "0", "5", "1", "1"], "--bounds"),
    (["--bounds", "-1e300", "-1e300", "1e300", "1e300"], "pixels along a side"),
    pytest.param(["--bounds", "0", "0", "10", "10", "--resolution", "1"], "other --bounds",
                 marks=pytest.mark.slow),
    pytest.param(["--contours", "1e-300", "--resolution", "1"], "larger interval",
                 marks=pytest.mark.slow),  # after drawing
]


@pytest.fixture
def mapped(tmp_path, monkeypatch):
    """A function of words, and of the georeference of the scene."""

    def call(words, place=made.UTM):
        monkeypatch.setattr(Run, "open", lambda path: run_of(path, made.scene(place)))
        folder = tmp_path / "map"
        return folder, CliRunner().invoke(main, ["map", "run", "-o", str(folder), *words])
    return call


@pytest.mark.parametrize("words, message", REFUSED, ids=lambda value: " ".join(value)
                         if isinstance(value, list) else "")
def test_refused_in_one_line(mapped, words, message):
    folder, result = mapped(words)
    assert result.exit_code == 2 and message in result.output, result.output
    line = result.output.strip().splitlines()[-1]
    assert line.startswith(("error: ", "Error: ")) and len(line) < 400, line
    assert not folder.exists() or not any(folder.iterdir())


@pytest.mark.slow
def test_all_that_a_georeference_holds_is_told(mapped):
    known = dataclasses.replace(
        made.UTM, crs=normal_crs(COMPOUND), vertical="EGM96 height (EPSG:5773)",
        warnings=("the residual is 9 % of the flight's size: check the GPS",),
        residuals=tuple(Residual(str(sign), "check", sign * 0.25, 0.25, None) for sign in (-1, 1)))
    folder, result = mapped(["--resolution", "0.5", "--bounds", *NEAR], known)
    assert result.exit_code == 0, result.output
    for words in ("heights: EGM96 height", "residual 0.10 m", "warning: the residual is 9 %",
                  "check RMS: east 0.25 m, north 0.25 m"):
        assert words in result.output
    record = json.loads((folder / "map.json").read_text())
    assert record["georeference"]["residuals_rms"] == {"check": {"east": 0.25, "north": 0.25}}
    with rasterio.open(folder / "surface.tif") as file:
        assert file.shape == (record["rows"], record["columns"]) == (16, 16)
        assert file.tags()["VERTICAL_REFERENCE"].startswith("EGM96 height")
        assert file.crs == rasterio.CRS.from_user_input(COMPOUND)
        assert abs(np.nanmax(file.read(1)) - MIDDLE[2] - made.ROOF) < 0.1
