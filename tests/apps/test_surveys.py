"""Two surveys of a made site, of which the shift and all changes are known."""

import json

import numpy as np
import pytest
import rasterio

from clsplat.apps.differences import nmad, noise_of
from clsplat.apps.measure import measure
from clsplat.apps.surveys import write_comparison
from clsplat.errors import InputError
from clsplat.io.georeference.geojson import read_features
from tests.apps.test_map_files import stops
from tests.apps.test_measure import NOISE, noisy, refused
from tests.command_line import clsplat_
from tests.data.surfaces import (
    MIDDLE,
    PIXEL,
    SIDE,
    circle,
    feature,
    heap,
    places,
    square,
    write_features,
    write_surface,
)

SHIFT = np.array([0.37, -0.23, 0.15])  # that must be added to the later survey
HOUSES = (-15, -10, 4, 6.0), (14, 12, 3, 5.0), (-12, 15, 5, 8.0)  # x, y, half a side, height
GONE = 18, -18, 3, 5.0
HEAP = 3.0, 2.0, 8.0, 3.0  # x, y, radius, height
FINER = 4


def hills(x, y):
    return 50 + 0.8 * np.sin(x / 7) * np.cos(y / 9) + 0.02 * x


def site(houses, new_heap, shift=(0, 0, 0), relief=hills):
    """The mean heights of pixels of a survey that is off by a shift."""
    x, y = (each + off for each, off in zip(places(PIXEL / FINER, SIDE * FINER), shift))
    heights = relief(x, y)
    for left, bottom, half, height in houses:
        inside = (np.abs(x - left) < half) & (np.abs(y - bottom) < half)
        heights = np.where(inside, 50 + height, heights)
    if new_heap:
        heights = heights + heap(x - HEAP[0], y - HEAP[1], *HEAP[2:])
    return heights.reshape(SIDE, FINER, SIDE, FINER).mean((1, 3)) - shift[2]


@pytest.fixture(scope="module")
def surveys(tmp_path_factory):
    """The path of a survey, the folder, the record of its comparison with another one by the
    command, which reads folders of maps, and what that printed."""
    folder = tmp_path_factory.mktemp("surveys")
    for name, heights in (("old", noisy(site((*HOUSES, GONE), False))), ("new", noisy(site(HOUSES, True, SHIFT), 2))):
        (folder / name).mkdir()
        write_surface(folder / name / "surface.tif", heights)
    result = clsplat_("compare-surveys", folder / "old", folder / "new", "-o", folder / "c")
    assert result.exit_code == 0, result.output
    record = json.loads((folder / "c" / "comparison.json").read_text())
    return folder / "old" / "surface.tif", folder, record, result.output


def true_volumes():
    x, y = places()
    inside = (np.abs(x - GONE[0]) < GONE[2]) & (np.abs(y - GONE[1]) < GONE[2])
    cut = (50 + GONE[3] - hills(x, y))[inside].sum() * PIXEL**2
    return np.pi / 2 * HEAP[2] ** 2 * HEAP[3], cut


def test_a_known_shift_and_known_changes_are_found(surveys):
    _, _, record, _ = surveys
    found = np.array([record["shift"][axis] for axis in ("east", "north", "up")])
    assert np.abs(found - SHIFT).max() < 0.1 * PIXEL, found
    fill, cut = true_volumes()
    assert abs(record["fill"] / fill - 1) < 0.02 and abs(record["cut"] / cut - 1) < 0.02
    changed = np.pi * HEAP[2] ** 2 + (2 * GONE[2]) ** 2
    assert abs(record["changed"] / changed - 1) < 0.05
    assert record["horizontal_shift_found"] and record["compared"] > 0.97


def test_the_noise_is_that_of_stable_ground(surveys):
    _, folder, record, _ = surveys
    assert 1.0 < record["noise"] / NOISE < 2**0.5 * 1.05, "of both, one of which is interpolated"
    assert record["level_of_detection"] == pytest.approx(1.96 * record["noise"])
    with rasterio.open(folder / "c" / "difference.tif") as file:
        noise = file.read(2)
    x, y = places()
    level = np.zeros(x.shape, bool)
    level[66:86, 66:86] = True
    wall = np.abs(np.maximum(np.abs(x + 15), np.abs(y + 10)) - 4) < 0.1
    assert wall.any() and noise[wall].min() > 1.5 * np.median(noise[level])


def test_the_files(surveys):
    before, folder, _, _ = surveys
    assert {path.name for path in (folder / "c").iterdir()} == {
        "aligned.tif",
        "difference.tif",
        "difference.png",
        "comparison.json",
        "aligned.qml",
        "difference.qml",
    }
    with (
        rasterio.open(folder / "c" / "difference.tif") as file,
        rasterio.open(before) as first,
        rasterio.open(folder / "c" / "aligned.tif") as aligned,
    ):
        assert file.transform == first.transform == aligned.transform and file.crs == first.crs
        assert file.descriptions == ("difference", "noise") and aligned.tags()
        difference, _ = file.read()
        assert np.allclose(aligned.read(1) - first.read(1), difference, atol=1e-4, equal_nan=True)
    x, y = places()
    top = np.hypot(x - HEAP[0], y - HEAP[1]) < 0.5
    assert abs(difference[top].mean() - HEAP[3]) < 0.05
    gone = np.hypot(x - GONE[0], y - GONE[1]) < 2
    assert difference[gone].max() < -4
    still = np.hypot(x + 15, y + 10) < 3
    assert np.abs(difference[still]).mean() < 2 * NOISE


def test_the_styles_have_the_range_of_the_heights_and_of_the_changes(surveys):
    folder = surveys[1] / "c"
    values, colours, labels = stops(folder / "difference.qml")
    values = np.array(values, float)
    assert np.allclose(values, -values[::-1]) and values[2] == 0 and labels[2] == "0.00 m"
    assert 0.8 * GONE[3] < values[-1] < 1.2 * GONE[3], "of the house, the strongest change"
    red, white, blue = (np.array(bytearray.fromhex(colours[place][1:])) for place in (0, 2, -1))
    assert red[0] > red[2] + 50 and blue[2] > blue[0] + 50 and white.min() > 230
    with rasterio.open(folder / "aligned.tif") as file:
        ends = np.nanquantile(file.read(1), (0.02, 0.98))
    assert np.allclose(np.array(stops(folder / "aligned.qml")[0], float)[[0, -1]], ends, atol=1e-3)


def test_the_picture_has_what_grew_in_blue_and_what_went_in_red(surveys):
    from matplotlib.image import imread

    picture = imread(surveys[1] / "c" / "difference.png")[..., :3]
    red, blue = (picture[..., first] - picture[..., second] > 0.3 for first, second in ((0, 2), (2, 0)))
    (red_row, red_column), (blue_row, blue_column) = (
        np.median(np.nonzero(each[:, : picture.shape[1] * 3 // 4]), axis=1) for each in (red, blue)
    )
    assert red_row > blue_row and red_column > blue_column, "south-east of the heap"


def test_the_moved_surface_is_measured_against_the_earlier(surveys, tmp_path):
    before, folder, _, _ = surveys
    shapes = write_features(
        tmp_path / "f.json",
        feature("Polygon", [circle(HEAP[2] + 0.5, middle=MIDDLE + HEAP[:2])]),
        feature("Polygon", [square(GONE[2] + 1, MIDDLE + GONE[:2])]),
    )
    aligned = folder / "c" / "aligned.tif"
    rows = measure(aligned, read_features(shapes, "EPSG:32633"), before=before).record["features"]
    fill, cut = true_volumes()
    assert abs(rows[0]["net"] / fill - 1) < 0.02 and abs(rows[1]["cut"] / cut - 1) < 0.02


def test_the_command_names_its_folders_and_keeps_what_is_there(surveys):
    _, folder, record, printed = surveys
    paths = folder / "old", folder / "new"
    assert (record["before"], record["after"]) == tuple(map(str, paths))
    assert f"moved by {record['shift']['east']:.2f}" in printed
    again = clsplat_("compare-surveys", *paths, "-o", folder / "c")
    assert again.exit_code == 2 and "--overwrite" in again.output


def test_level_ground_shows_no_shift_along_it(tmp_path):
    x, _ = places(side=100)
    before, after = (write_surface(tmp_path / f"{seed}.tif", noisy(0 * x + 50 + seed, seed)) for seed in (1, 2))
    result = clsplat_("compare-surveys", before, after, "-o", tmp_path / "c")
    assert result.exit_code == 0 and "too level" in result.output
    record = json.loads((tmp_path / "c" / "comparison.json").read_text())
    assert not record["horizontal_shift_found"] and record["fill"] + record["cut"] < 1
    assert record["shift"]["east"] == 0 and abs(record["shift"]["up"] + 1) < 1e-3


@pytest.mark.slow
def test_surveys_of_other_pixels_and_with_gaps(tmp_path):
    before = noisy(site((*HOUSES, GONE), False))
    before[133:200, :53] = np.nan
    first = write_surface(tmp_path / "a.tif", before)
    with rasterio.open(first, "r+") as file:
        file.update_tags(VERTICAL_REFERENCE="EGM96 height")
    after = noisy(site(HOUSES, True, SHIFT), 2).reshape(SIDE // 2, 2, SIDE // 2, 2).mean((1, 3))
    record = write_comparison(first, write_surface(tmp_path / "b.tif", after, pixel=2 * PIXEL), tmp_path / "c")
    with rasterio.open(tmp_path / "c" / "aligned.tif") as file:
        assert file.tags()["VERTICAL_REFERENCE"] == "EGM96 height"
    found = np.array([record["shift"][axis] for axis in ("east", "north", "up")])
    assert np.abs(found - SHIFT).max() < 0.2 * PIXEL, found
    assert abs(record["fill"] / true_volumes()[0] - 1) < 0.02


def test_noise_figures():
    values = np.random.default_rng(0).normal(3, 0.5, 100_000)
    values[:20_000] += 40
    assert abs(nmad(values) / 0.5 - 1) < 0.45 and abs(nmad(values[20_000:]) / 0.5 - 1) < 0.02
    white = np.random.default_rng(0).normal(0, 1, (400, 400))
    assert abs(noise_of(white, 0.5, 100.0) / (20 * 0.25) - 1) < 0.15
    assert noise_of(white, 0.5, 1e5) is None


def test_what_cannot_be_compared_is_refused_in_one_line(surveys, tmp_path):
    before, *_ = surveys
    x, _ = places()
    other = write_surface(tmp_path / "other.tif", 0 * x, crs="EPSG:32632")
    far = write_surface(tmp_path / "far.tif", 0 * x, left=9e5)
    empty = write_surface(tmp_path / "empty.tif", np.nan * x)
    local = write_surface(tmp_path / "local.tif", 0 * x, crs=None)
    output = "-o", tmp_path / "o"
    for name, message in (
        (other, "gdalwarp"),
        (far, "share hardly any"),
        (empty, "no heights"),
        (local, "no georeference"),
        (tmp_path, "holds no run"),
    ):
        refused(clsplat_("compare-surveys", before, name, *output), message)
    assert not (tmp_path / "o").exists()
    with pytest.raises(InputError, match="far.tif: the surveys share"):
        write_comparison(before, far, tmp_path / "o")
