"""Models in files of every format: the suffix of a name selects the format."""

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clsplat.errors import InputError
from clsplat.gaussians import Gaussians
from clsplat.georeference import Georeference
from clsplat.io.models.gltf import read_glb, write_glb
from clsplat.io.models.ply import gaussians_of, read_vertices, write_ply
from clsplat.io.models.points import cloud, is_cloud, ply_points, read_las, write_las
from clsplat.io.models.sog import META, read_sog, write_sog
from clsplat.io.models.spz import read_spz, write_spz
from clsplat.io.models.usd import write_usd
from clsplat.io.models.values import Notes


def _read_ply(path: Path, offset: NDArray[np.float64] | None) -> tuple[Gaussians, Notes]:
    """Whatever a PLY holds: gaussians or points."""
    vertices, comments = read_vertices(path)
    found = (
        cloud(path, *ply_points(path, vertices), offset)
        if is_cloud(vertices)
        else gaussians_of(path, vertices, comments, offset)
    )
    return found, Notes.of_lines(comments)


class Format(NamedTuple):
    """A format of models: what it is and its functions, of which one that is not read lacks the
    first; points have map coordinates in files of a georeferenced scene, and no harmonics."""

    what: str
    # called with a path, an offset, and for points with the CRS of the scene
    read: Callable[..., tuple[Gaussians, Notes]] | None
    # called with a path, gaussians and notes, and for SPZ with a version
    write: Callable[..., None]
    is_points: bool = False


FORMATS = {
    ".ply": Format(
        "the format of Kerbl et al. 2023, which splat viewers open",
        _read_ply,
        lambda path, gaussians, notes: write_ply(path, gaussians, gaussians.offset, notes.lines),
    ),
    ".sog": Format("the format of PlayCanvas, the smallest", read_sog, write_sog),
    ".spz": Format("the format of Niantic, small", read_spz, write_spz),
    ".glb": Format("glTF with KHR_gaussian_splatting", read_glb, write_glb),
    **{
        suffix: Format(f"OpenUSD, {what}, which is not read", None, write_usd)
        for suffix, what in ((".usdz", "packed"), (".usdc", "binary"), (".usda", "text"))
    },
    ".laz": Format("points for maps, compressed", read_las, write_las, is_points=True),
    ".las": Format("points for maps", read_las, write_las, is_points=True),
}
SUFFIXES = tuple(suffix for suffix, kind in FORMATS.items() if kind.read)


def read_model(
    path: str | Path, offset: ArrayLike | None = None, georeference: Georeference | None = None
) -> Gaussians:
    """Read the gaussians of a file; see `read_with_notes`."""
    return read_with_notes(path, offset, georeference)[0]


def read_with_notes(
    path: str | Path, offset: ArrayLike | None = None, georeference: Georeference | None = None
) -> tuple[Gaussians, Notes]:
    """Read the gaussians of a file in local coordinates, and what it holds besides: how they were
    trained, what is up, and their georeference, as far as its format has a place for these.

    A cloud of points, with or without colours, becomes the gaussians from which a training starts.

    Parameters
    ----------
    path : a file with one of SUFFIXES, or the meta.json of an unpacked SOG.
    offset : float64[3], original coordinates of the origin of the local ones; None: the one that
        the file records.
    georeference : of the scene for which it is read: LAS and LAZ hold map coordinates, which
        become original ones; InputError if they name another CRS.

    Raises
    ------
    InputError : the suffix is unknown, or the file is missing, damaged or of another format.
    """
    path = Path(path)
    kind, read = _readable(path)
    local = None if offset is None else np.asarray(offset, np.float64)
    if kind.is_points and georeference is not None:
        origin = np.asarray(georeference.offset, np.float64)
        found, notes = read(path, None if local is None else origin + local, georeference.crs)
        return found.located(found.offset - origin), notes
    return read(path, local)


def count_of(path: str | Path) -> int:
    """How many gaussians or points a file holds; raises as `read_model` does.

    Of a PLY only the header is read, unless its rows are text.
    """
    path = Path(path)
    _, read = _readable(path)
    if read is _read_ply:
        return int(read_vertices(path)[0].count)
    return read(path, None)[0].count


def _readable(path: Path) -> tuple[Format, Callable[..., tuple[Gaussians, Notes]]]:
    """The format of a file and what reads it; InputError for one that is only written."""
    kind = format_of(path)
    if kind.read is None:
        raise InputError(f"{path}: {kind.what}; give the model as {', '.join(SUFFIXES)}")
    return kind, kind.read


def write_model(
    path: str | Path,
    gaussians: Gaussians,
    comments: Iterable[str] = (),
    up: ArrayLike | None = None,
    georeference: Georeference | None = None,
    spz_version: int = 0,
) -> None:
    """Write gaussians in original coordinates; the file is replaced as a whole.

    Formats in single precision hold coordinates relative to the offset if original ones would lose
    digits, and record the offset. LAS and LAZ hold map coordinates.

    Parameters
    ----------
    path : a file with one of SUFFIXES.
    comments, up, georeference : see `Notes`; for the formats that have a place for them.
    spz_version : one of `spz.VERSIONS`, for SPZ alone; 0: the first of them.

    Raises
    ------
    InputError : the suffix is unknown, the format cannot hold these gaussians, or the file cannot
        be written.
    """
    path = Path(path)
    notes = Notes(tuple(comments), None if up is None else np.asarray(up, np.float64), georeference)
    format_of(path).write(path, gaussians, notes, *[spz_version] * bool(spz_version))


def format_of(path: str | Path) -> Format:
    """The format that the suffix of a file selects; InputError if it is unknown."""
    path = Path(path)
    unpacked = path.name == META or (path / META).is_file()
    found = FORMATS[".sog"] if unpacked else FORMATS.get(path.suffix.lower())
    if found is None:
        known = "; ".join(f"{suffix} ({kind.what})" for suffix, kind in FORMATS.items())
        raise InputError(f"{path}: unknown suffix '{path.suffix}'; known: {known}")
    return found
