"""LAS and LAZ files whose headers claim more than they have are refused before they are read."""

import struct

import numpy as np
import pytest

from clsplat.errors import InputError
from clsplat.gaussians import Gaussians
from clsplat.io.models.formats import read_model, write_model
from clsplat.io.models.las_header import check_las

laspy = pytest.importorskip("laspy")
COUNT, RECORDS = (247, "<Q"), (243, "<I")  # of points, of extended records, in version 1.4


def written(path, count=300):
    random = np.random.default_rng(0)
    write_model(path, Gaussians.from_points(random.normal(size=(count, 3)), random.integers(
        0, 256, (count, 3), dtype=np.uint8), 0))
    return path


def changed(path, place, form, value):
    data = bytearray(path.read_bytes())
    struct.pack_into(form, data, place, value)
    path.write_bytes(data)
    return path


@pytest.mark.parametrize("suffix", [".las", ".laz"])
@pytest.mark.parametrize("place, form, value, words", [
    (*RECORDS, 2**31, "records"), (*COUNT, 2**40, "points|chunks|hold"),
    (96, "<I", 2**31, "header"),
    (100, "<I", 2**31, "records")])
def test_claims_of_the_header(tmp_path, suffix, place, form, value, words):
    """laspy counted to 2^31 records, and lazrs allocated what it was told."""
    path = changed(written(tmp_path / f"model{suffix}"), place, form, value)
    with pytest.raises(InputError, match=words):
        read_model(path)


def test_claims_of_the_compression(tmp_path):
    """lazrs ended the process when it could not allocate 57 GB: for a table of chunks, and for the
    layers of a chunk."""
    whole = written(tmp_path / "whole.laz").read_bytes()
    begin, = struct.unpack_from("<I", whole, 96)
    table, = struct.unpack_from("<q", whole, begin)
    record = 375 + 54
    width, = struct.unpack_from("<H", whole, 105)
    for place, form, value in ((begin, "<q", 2**40), (table + 4, "<I", 2**31),
                               (begin + 8 + width, "<I", 2**31),  # points of a chunk
                               (begin + 12 + width, "<I", 2**31),  # bytes of a layer
                               (record, "<H", 1), (record + 12, "<I", 7), (record + 32, "<H", 0)):
        path = tmp_path / "model.laz"
        path.write_bytes(whole)
        with pytest.raises(InputError, match="model.laz"):
            read_model(changed(path, place, form, value))


def test_files_of_other_programs(tmp_path):
    """Several chunks, older point formats and extra bytes pass."""
    random = np.random.default_rng(0)
    for number, (form, version) in enumerate(((2, "1.2"), (3, "1.2"), (7, "1.4"), (8, "1.4"))):
        header = laspy.LasHeader(version=version, point_format=form)
        header.scales = np.full(3, 1e-3)
        if number % 2:
            header.add_extra_dim(laspy.ExtraBytesParams(name="normal", type="3f4"))
        las = laspy.LasData(header)
        las.xyz = random.normal(size=(70_000, 3))
        las.write(str(tmp_path / "model.laz"))
        with open(tmp_path / "model.laz", "rb") as file:
            check_las(file, file.seek(0, 2))
