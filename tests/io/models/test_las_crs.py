"""Points of laser scanners are refused if their file names another CRS than the scene's."""

from dataclasses import replace

import numpy as np
import pyproj
import pytest

from clsplat.errors import InputError
from clsplat.georeference import Georeference
from clsplat.io.models.formats import read_model

laspy = pytest.importorskip("laspy", reason="laspy is an extra: pip install 'clsplat[geo]'")
PLACE = Georeference("EPSG:32755", (686696.0, 6090238.0, 100.0), "GPS", 0.1)
POINTS = np.random.default_rng(0).uniform(0, 50, (40, 3))  # original coordinates
COMPOUND = "EPSG:32755+5773"


def write(path, points, crs=None, version="1.4"):
    header = laspy.LasHeader(version=version, point_format=2 if version == "1.2" else 7)
    fine = 1e-8 if np.abs(points[:, :2]).max() < 400 else 1e-3
    header.scales = np.array([fine, fine, 1e-3])
    header.offsets = np.floor(points.min(axis=0))
    if crs is not None:
        header.add_crs(pyproj.CRS.from_user_input(crs))
    las = laspy.LasData(header)
    las.x, las.y, las.z = points.T
    las.write(str(path))
    return path


def in_crs(crs):
    """POINTS in another CRS, east first."""
    places = POINTS + PLACE.offset
    to = pyproj.Transformer.from_crs(PLACE.crs, crs, always_xy=True)
    return np.column_stack([*to.transform(*places[:, :2].T), places[:, 2]])


@pytest.mark.parametrize(
    "crs", ["EPSG:4979", "EPSG:28355", "EPSG:4326+5773", "EPSG:32755+6360", "+proj=utm +zone=55 +south +units=us-ft"]
)
def test_files_of_another_crs_are_refused(tmp_path, crs):
    flat = crs.partition("+")[0] if crs.startswith("EPSG") else crs
    path = write(tmp_path / "a.laz", in_crs(flat), crs)
    with pytest.raises(InputError, match=r"a\.laz: its points are in .*EPSG:32755; convert them"):
        read_model(path, georeference=PLACE)


@pytest.mark.parametrize(
    "version, crs, own",
    [
        ("1.2", "EPSG:32755", PLACE.crs),
        ("1.4", None, PLACE.crs),
        ("1.4", "EPSG:32755", COMPOUND),
        ("1.4", COMPOUND, COMPOUND),
        ("1.4", COMPOUND, PLACE.crs),
    ],
)
def test_files_of_the_scenes_crs_or_of_none_stay(tmp_path, version, crs, own, caplog):
    path = write(tmp_path / "a.las", POINTS + PLACE.offset, crs, version)
    found = read_model(path, georeference=replace(PLACE, crs=own))
    assert np.abs(found.positions + found.offset - POINTS).max() < 0.01 and not caplog.records
    alone = read_model(write(tmp_path / "b.las", in_crs("EPSG:4326"), "EPSG:4326"))
    assert abs((alone.positions + alone.offset)[0, 0] - 149) < 1  # without a scene, its own


def test_a_record_of_the_crs_that_is_damaged_is_none(tmp_path):
    path = write(tmp_path / "a.las", POINTS + PLACE.offset, "EPSG:32755")
    data = path.read_bytes()
    for word in (b"PROJCRS", b"PROJCS", b"METHOD", b"UNIT"):
        data = data.replace(word, b"\xff" * len(word))
    path.write_bytes(data)
    found = read_model(path, georeference=PLACE)
    assert np.abs(found.positions + found.offset - POINTS).max() < 0.01
