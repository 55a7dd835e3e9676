"""Points with colours as gaussians: those of a PLY, and of LAS and LAZ, the formats of laser
scanners and of maps.

In LAS and LAZ, gaussians are written as their centres, with colour, and with opacity as the
intensity. They have map coordinates if the scene is georeferenced: the format has room for large
numbers.
"""

import struct
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
import plyfile
from numpy.typing import NDArray

from clsplat.errors import InputError, clean, reason
from clsplat.gaussians import Gaussians
from clsplat.io.atomic import replacing
from clsplat.io.fields import LARGEST_COORDINATE, reading
from clsplat.io.georeference.crs import is_on_map, pyproj_crs
from clsplat.io.models.values import Notes, colours_of, opacities, usable
from clsplat.io.regular import check_expansion, open_regular

GREY = 128  # of points without colours
FAR = 1e4  # units from the origin, from which a cloud gets local coordinates of its own
VERSION, POINT_FORMAT = "1.4", 7  # with colours of 16 bits, and a CRS as WKT
STEPS = (1 << 31) - 1  # of a coordinate, above and below its offset
FINEST_STEP, STEPS_A_SCALE = 1e-6, 10
COLOURS = ("red", "green", "blue")
HEADER, RECORD_HEAD_BYTES = struct.Struct("<96xII"), 54  # offset to the points, records before them
RECORD_BYTES = 24  # that are read of a point: three coordinates and three colours


def is_cloud(element: plyfile.PlyElement) -> bool:
    """Whether vertices are points rather than gaussians."""
    names = element.data.dtype.names
    return all(name in names for name in "xyz") and not any(
        name.startswith(("f_dc_", "scale_", "rot_", "opacity")) for name in names
    )


def ply_points(path: Path, element: plyfile.PlyElement) -> tuple[NDArray[np.float64], NDArray[Any] | None]:
    """The points float64[N, 3] of vertices and, if they have any, their colours [N, 3], as they
    are stored; InputError if these are no points."""
    rows = element.data
    numbers = [name for name in rows.dtype.names if rows.dtype[name].kind in "fiu"]
    if not set("xyz") <= set(numbers):
        raise InputError(f"{path}: its vertices have no numbers x, y and z; give a PLY of points")
    points = np.stack([rows[name].astype(np.float64) for name in "xyz"], axis=1)
    has_colours = set(COLOURS) <= set(numbers)
    return points, np.stack([rows[name] for name in COLOURS], axis=1) if has_colours else None


def cloud(
    path: Path, points: NDArray[np.float64], colours: NDArray[np.generic] | None, offset: NDArray[np.float64] | None
) -> Gaussians:
    """Gaussians on points in original coordinates; colours have 8 or 16 bits, or are float from 0
    to 1. Without an offset: that of points far from the origin is their middle in whole units."""
    if colours is None:
        colours = np.full(points.shape, GREY, np.uint8)
    rows = usable(
        path,
        {
            "positions": np.where(np.abs(points) <= LARGEST_COORDINATE, points, np.nan),
            "colours": np.nan_to_num(colours),
        },
    )
    points, shown = rows["positions"], rows["colours"].astype(np.float64)
    if not len(points) or (points == points[0]).all():
        raise InputError(
            f"{path}: its {len(points)} points have fewer than two places; gaussians "
            "take their size from the distance of points, so give a larger cloud"
        )
    if offset is None:
        middle = np.rint(np.median(points, axis=0))
        offset = middle if np.abs(middle).max() > FAR else np.zeros(3)
    if colours.dtype.kind == "f":
        shown *= 255
    elif shown.max() > 255:  # some programs write 8 bits into 16
        shown /= 257
    return Gaussians.from_points(points - offset, np.clip(np.rint(shown), 0, 255).astype(np.uint8), 0).located(offset)


def write_las(path: Path, gaussians: Gaussians, notes: Notes) -> None:
    """Write the centres of gaussians as LAS or, by the suffix, LAZ, with the opacity as intensity;
    see `models.write_model`. Coordinates are rounded to a power of ten."""
    points = gaussians.positions.astype(np.float64) + gaussians.offset
    typical = np.exp(float(np.median(gaussians.log_scales))) if gaussians.count else 1.0
    place = notes.georeference
    if place is not None:
        points = place.to_map(points)
    laspy = _laspy_for(path)
    header = laspy.LasHeader(version=VERSION, point_format=POINT_FORMAT)
    header.generating_software = "clsplat"
    if place is not None:
        header.add_crs(pyproj_crs(place.crs, f"{path}: CRS"))
    low, high = (points.min(axis=0), points.max(axis=0)) if len(points) else np.zeros((2, 3))
    header.offsets = np.rint((low + high) / 2)
    reach = np.abs([low - header.offsets, high - header.offsets]).max()
    step = max(typical / STEPS_A_SCALE, FINEST_STEP)  # coarser if 32 bits cannot hold it
    header.scales = np.full(
        3, max(10.0 ** np.floor(np.log10(step)), 10.0 ** np.ceil(np.log10(max(reach, 1e-300) / STEPS)))
    )
    las = laspy.LasData(header)
    las.x, las.y, las.z = points.T
    las.red, las.green, las.blue = _shares(colours_of(gaussians.sh_constant)).T
    las.intensity = _shares(opacities(gaussians))
    with replacing(path) as file:
        las.write(file, do_compress=path.suffix.lower() == ".laz")


def read_las(path: Path, offset: NDArray[np.float64] | None = None, crs: str | None = None) -> tuple[Gaussians, Notes]:
    """Read the points of a LAS or LAZ file as gaussians; InputError if it names another CRS; see
    `models.read_with_notes`."""
    laspy = _laspy_for(path)
    with reading(path, "a LAS or LAZ file"), open_regular(path) as file:
        size = file.seek(0, 2)
        file.seek(0)
        begin, records = HEADER.unpack(file.read(HEADER.size))
        if begin > size or records * RECORD_HEAD_BYTES > begin:  # laspy would count to 2^32
            raise ValueError("its header claims more than it holds")
        file.seek(0)
        # the parallel decompressor allocates what the file's table of chunks claims
        with (
            _no_panic(),
            laspy.open(file, closefd=False, read_evlrs=False, laz_backend=laspy.LazBackend.Lazrs) as reader,
        ):
            header = reader.header
            count, width = header.point_count, header.point_format.size
            if header.are_points_compressed:
                check_expansion(size, count * max(width, RECORD_BYTES))
            elif header.offset_to_point_data + count * width > size:
                raise ValueError(f"its {size} bytes are too few for {count} points")
            found = reader.read_points(count)  # `read` would count records behind them to 2^32
        points, colours = np.stack([found.x, found.y, found.z], axis=1), None
        if len(points) != count:
            raise ValueError(f"it has {len(points)} points, not {count}")
        if set(COLOURS) <= set(header.point_format.dimension_names):
            colours = np.stack([found[name] for name in COLOURS], axis=1)
        if crs is not None:
            _check_crs(path, header, crs)
        return cloud(path, points, colours if np.any(colours) else None, offset), Notes()


def _check_crs(path: Path, header: Any, crs: str) -> None:
    """InputError if a file names another CRS than the scene's."""
    system = None
    with suppress(Exception):  # of any kind, for damaged records
        system = header.parse_crs()
    if system is not None and not is_on_map(system, crs):
        raise InputError(
            f"{path}: its points are in {clean(system.name)}, and the scene is in "
            f"{clean(crs)[:60]}; convert them (with PDAL), or georeference the scene "
            "again with their --crs"
        )


def _shares(values: NDArray[np.floating]) -> NDArray[np.uint16]:
    """Numbers 0 to 1 in 16 bits."""
    return np.asarray(np.clip(np.rint(values * 65535), 0, 65535), np.uint16)


def _laspy_for(path: Path) -> Any:
    """laspy; InputError, which names the file that needs it, if it or lazrs is not installed."""
    try:
        import laspy
        import lazrs  # noqa: F401  # without which laspy reads no LAZ
    except ImportError:
        raise InputError(f"{path}: LAS and LAZ need laspy and lazrs; `pip install laspy lazrs`") from None
    return laspy


@contextmanager
def _no_panic() -> Iterator[None]:
    """lazrs, which is written in Rust, ends with a panic where it does not expect damage."""
    try:
        yield
    except BaseException as error:
        if type(error).__name__ != "PanicException":
            raise
        raise ValueError(reason(error)) from None
