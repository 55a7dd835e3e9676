"""Files of ground control points."""

import pyproj
import pytest

from clsplat.errors import InputError
from clsplat.io.georeference.control_points import read_control_points
from tests.refusals import refused

ODM = """EPSG:32614
# a comment
587000.5 3338000.25 300 10 20 a.jpg north
587000.5 3338000.25 300\t11.5 21\tb.jpg\tnorth
587100 3338100 301 5 6 a.jpg
"""
CSV = """WGS84 UTM 14N
name,x,y,z,pixel_x,pixel_y,image
north,587000.5,3338000.25,300,10,20,a.jpg
north,587000.5,3338000.25,300,11.5,21,b.jpg
,587100,3338100,301,5,6,a.jpg
"""


@pytest.mark.parametrize("text", [ODM, CSV, "\ufeff" + CSV.replace("\n", "\r\n")])
def test_both_formats(tmp_path, text):
    path = tmp_path / "gcp.txt"
    path.write_text(text, encoding="utf-8")
    read = read_control_points(path)
    north, other = read.points
    assert read.crs == "EPSG:32614" and not read.notes
    assert north.name == "north" and north.position == (587000.5, 3338000.25, 300)
    assert north.marks == (("a.jpg", 10, 20), ("b.jpg", 11.5, 21))
    assert other.name == "point 2" and other.marks == (("a.jpg", 5, 6),)


ROW = "587000.5 3338000.25 300 10 20 a.jpg north"
NAMES = "geo_x geo_y geo_z im_x im_y image_name gcp_name"


@pytest.mark.parametrize(
    "text",
    [
        "EPSG:32614\n" + ROW.replace(" ", ";"),
        "EPSG:32614\n" + ROW.replace(" ", " ; "),
        "EPSG:32614;;;;;;\n" + ROW.replace(" ", ";").replace(".5", ",5").replace(".25", ",25"),
        "EPSG:32614\n" + ROW.replace(" ", ","),
        "EPSG:32614\n" + ROW.replace(" ", ", "),
        '"EPSG:32614"\n' + ROW.replace("a.jpg", '"a.jpg"'),
        f"EPSG:32614\n{NAMES}\n{ROW}\n",
        f"EPSG:32614\n{NAMES}\n{ROW} extra".replace(" ", "\t"),
        f"EPSG:32614\n  {ROW}   more \n",
        f"EPSG:32614\n{NAMES.upper()}\n{ROW}\n".replace(" ", ";"),
        "EPSG:32614\nname;x;y;z;pixel_x;pixel_y;image\nnorth;587000,5;3338000,25;300;10;20;a.jpg",
        "EPSG:32614\nimage,pixel_x,pixel_y,name,x,y,z\na.jpg,10,20,north,587000.5,3338000.25,300",
        'EPSG:32614\n"name","x","y","z","pixel_x","pixel_y","image"\n"north",587000.5,3338000.25,300,10,20,"a.jpg"',
    ],
)
def test_any_separator_and_header(tmp_path, text):
    path = tmp_path / "gcp.txt"
    path.write_text(text)
    read = read_control_points(path)
    assert read.crs == "EPSG:32614"
    assert [(point.name, point.position, point.marks) for point in read.points] == [
        ("north", (587000.5, 3338000.25, 300), (("a.jpg", 10, 20),))
    ]


def test_check_points_are_those_that_are_named(tmp_path):
    path = tmp_path / "gcp.txt"
    path.write_text(ODM)
    assert [point.is_check for point in read_control_points(path, checks=["point 2"]).points] == [False, True]
    with pytest.raises(InputError, match="--check-point east: .* it has north, point 2"):
        read_control_points(path, checks=["east"])


@pytest.mark.parametrize("crs", ["EPSG:4326", "EPSG:3857"])
def test_degrees_and_web_mercator_become_metres_of_the_utm_zone(tmp_path, crs):
    place = 587637.54, 3338094.73
    x, y = pyproj.Transformer.from_crs("EPSG:32614", crs, always_xy=True).transform(*place)
    path = tmp_path / "gcp.txt"
    path.write_text(f"{crs}\n{x} {y} 300 10 20 a.jpg\n")
    read = read_control_points(path)
    assert read.crs == "EPSG:32614"
    assert read.points[0].position == pytest.approx((*place, 300), abs=0.01)


def test_the_crs_may_be_given_as_an_option(tmp_path):
    path = tmp_path / "gcp.csv"
    path.write_text(CSV.split("\n", 1)[1])
    assert read_control_points(path, "EPSG:32614").crs == "EPSG:32614"
    refused(lambda: read_control_points(path), "first line, such as EPSG:32632, or give --crs")


NO_CRS = "is not a coordinate reference system"


@pytest.mark.parametrize(
    "text, complaint",
    [
        ("", "names no coordinate reference system"),
        ("EPSG:32614\n", "has no ground control points"),
        ("EPSG:32614\n1 2 3 4\n", "line 2 lacks pixel_y, image"),
        ("EPSG:32614\n1 2 nan 4 5 a.jpg\n", "z of line 2 is not a usable number"),
        (CSV + "p,1,2,3\n", "line 6 lacks"),
        (b"\xff\xfe\0", "not a file of ground control points"),
        ("x" * 200_000, NO_CRS),
        ("EPSG:32614\n" + ROW.replace(".5", ",5"), "x of line 2 is not a number"),
        ("EPSG:32614\n" + ROW.replace("300", "3,0,0,0").replace(" ", ";"), "z of line 2 is not a num"),
        ("IMG_1.JPG,P1,100.5,200.5,1\n", NO_CRS),  # marks of Pix4D
        ("EPSG:32614\nP1;587000.5;3338000.25;300;0.02;0.02\n", "x of line 2 is not a number"),
        (CSV + "north,587000.6,3338000.25,300,1,2,c.jpg\n", "point north has several coordinates;"),
        (
            "EPSG:4326\n9.0 47.8 1 4 5 a.jpg\n9.0 478 1 4 5 a.jpg p\n",
            "point p has no coordinates in EPSG:32632; correct it",
        ),
    ],
)
def test_damaged_files(tmp_path, text, complaint):
    path = tmp_path / "gcp.txt"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(InputError, match=complaint):
        read_control_points(path)
    refused(lambda: read_control_points(tmp_path / "other.txt"), "no such file")


FEET = "EPSG:2227+6360\n6000000 2000000 984.1053 10 20 a.jpg\n"  # NAVD88, US survey feet
METRES = "EPSG:32632+5773\n500000 5200000 300 10 20 a.jpg\n"  # EGM96


@pytest.mark.one_in(3)
@pytest.mark.parametrize(
    "text, crs, height, target, vertical",
    [
        (FEET, "EPSG:26910+5703", 299.95590, "EPSG:26910", "NAVD88 height (ftUS)"),
        (FEET.replace("+6360", ""), "EPSG:26910+5703", 299.95590, "EPSG:26910", ""),
        (METRES, "EPSG:32632+5773", 300, "EPSG:32632+5773", "EGM96 height"),
        (METRES, "EPSG:25832", 300, "EPSG:25832", "EGM96 height"),
        (
            "EPSG:4979\n9 47 300 10 20 a.jpg\n",
            "EPSG:32632+5773",
            300,
            "EPSG:32632",
            "height above the ellipsoid of WGS 84",
        ),
    ],
)
def test_heights_keep_what_they_count_from(tmp_path, text, crs, height, target, vertical):
    """They become metres, and are never labelled as those of another vertical CRS."""
    path = tmp_path / "gcp.txt"
    path.write_text(text)
    read = read_control_points(path, crs)
    assert (read.crs, read.vertical) == (target, vertical)
    assert read.points[0].position[2] == pytest.approx(height, abs=1e-4)
    assert any("not labelled as" in note for note in read.notes) == ("+" in crs and target != crs)
