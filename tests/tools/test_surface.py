"""The study of how true a surface is, on one that is true but for a pit."""

import numpy as np
import pytest
import rasterio

from clsplat.synth import layout
from clsplat.synth.geometry import save
from tools.studies import surface


@pytest.mark.slow
def test_a_pit_in_a_true_surface_is_found(tmp_path, monkeypatch, capsys):
    city, size = layout.city((1, 1)), 0.1
    side = np.arange(-15, 15, size) + size / 2 + 3e-4  # on no edge of a solid
    heights = surface.true_heights(city, *np.meshgrid(side, side[::-1])) + 0.01
    heights[150:153, 150:160] -= 30
    with rasterio.open(tmp_path / "surface.tif", "w", driver="GTiff", width=300, height=300,
                       count=1, dtype="float64", nodata=np.nan,
                       transform=rasterio.Affine(size, 0, -14.9997, 0, -size, 15.0003)) as file:
        file.write(heights, 1)
    save(city, tmp_path / "geometry.json")
    monkeypatch.setattr("sys.argv", ["surface", str(tmp_path), "--city",
                                     str(tmp_path / "geometry.json")])
    surface.main()
    first, second = capsys.readouterr().out.splitlines()
    assert "90,000 known" in first and "100.0% covered, error 0.010 (median)" in second
    assert "0.04% more than 2 too low, 0.00% too high" in second
