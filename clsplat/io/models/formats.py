"""Models in files of every format: the suffix of a name selects the format."""

from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clsplat.errors import InputError
from clsplat.gaussians import Gaussians
from clsplat.georeference import Georeference
from clsplat.io.models.compressed_ply import compressed_gaussians, is_compressed
from clsplat.io.models.gltf import glb_notes, read_glb, write_glb
from clsplat.io.models.ply import gaussians_of, read_elements, read_vertices, write_ply
from clsplat.io.models.points import is_cloud, ply_cloud, read_las, write_las
from clsplat.io.models.sog import is_unbundled, read_sog, sog_notes, write_sog
from clsplat.io.models.splat_file import read_splat
from clsplat.io.models.spz import read_spz, spz_notes, write_spz
from clsplat.io.models.values import Notes


def _read_ply(path: Path, offset: NDArray[np.float64] | None) -> Gaussians:
    """Whatever a PLY holds: gaussians, compressed gaussians or points."""
    elements, comments = read_elements(path)
    if is_compressed(elements):
        return compressed_gaussians(path, elements, comments, offset)
    if "vertex" not in elements:
        raise InputError(f"{path}: not a PLY of gaussians or points: it has no vertices; "
                         "give one that a gaussian splatting program wrote")
    if is_cloud(elements["vertex"]):
        return ply_cloud(path, elements["vertex"], offset)
    return gaussians_of(path, elements["vertex"], comments, offset)


class Format(NamedTuple):
    """A format of models: what it is, its functions, and what it holds."""

    what: str
    read: Callable[..., Gaussians]  # called as `read_model`; with map coordinates: and a CRS
    write: Callable[[Path, Gaussians, Notes], None] | None = None  # None: it is only read
    notes: Callable[[Path], Notes] = lambda _: Notes()
    harmonics: bool = True  # above the constant
    map_coordinates: bool = False  # in files of a georeferenced scene


PLY = Format("the format of Kerbl et al. 2023, which splat viewers open", _read_ply,
             lambda path, gaussians, notes: write_ply(path, gaussians, gaussians.offset,
                                                      notes.lines),
             lambda path: Notes.of_lines(read_elements(path)[1]))
FORMATS = {
    ".ply": PLY,
    ".sog": Format("the format of PlayCanvas, the smallest", read_sog, write_sog, sog_notes),
    ".spz": Format("the format of Niantic, small", read_spz, write_spz, spz_notes),
    ".glb": Format("glTF with KHR_gaussian_splatting", read_glb, write_glb, glb_notes),
    ".laz": Format("points for maps, compressed", read_las, write_las, harmonics=False,
                   map_coordinates=True),
    ".las": Format("points for maps", read_las, write_las, harmonics=False, map_coordinates=True),
}
SUFFIXES = tuple(FORMATS)
# formats of earlier years, or of other programs, which are read only; a longer suffix stands before
# the one with which it ends
READ = {".compressed.ply": PLY._replace(what="the format of SuperSplat", write=None), **FORMATS,
        ".splat": Format("of antimatter15's viewer", read_splat)}


def read_model(path: str | Path, offset: ArrayLike | None = None,
               georeference: Georeference | None = None) -> Gaussians:
    """Read the gaussians of a file in local coordinates.

    A cloud of points, with or without colours, becomes the gaussians from which a training starts.

    Parameters
    ----------
    path : a file with a suffix of READ, or SOG in a folder: that, or its meta.json.
    offset : float64[3], original coordinates of the origin of the local ones; None: the one that
        the file records.
    georeference : of the scene for which it is read: LAS and LAZ hold map coordinates, which
        become original ones, from whatever CRS they name.

    Raises
    ------
    InputError : the suffix is unknown, or the file is missing, damaged or of another format.
    """
    path, kind = Path(path), _stored_format(path)
    local = None if offset is None else np.asarray(offset, np.float64)
    if kind.map_coordinates and georeference is not None:
        origin = np.asarray(georeference.offset, np.float64)
        gaussians = kind.read(path, None if local is None else origin + local, georeference.crs)
        return gaussians.located(gaussians.offset - origin)
    return kind.read(path, local)


def count_of(path: str | Path) -> int:
    """How many gaussians or points a file holds; raises as `read_model` does.

    Of a PLY only the header is read, unless its rows are text.
    """
    path, kind = Path(path), _stored_format(path)
    if kind.read is _read_ply:
        return int(read_vertices(path)[0].count)
    return kind.read(path, None).count


def write_model(path: str | Path, gaussians: Gaussians, comments: Iterable[str] = (),
                up: ArrayLike | None = None, georeference: Georeference | None = None) -> None:
    """Write gaussians in original coordinates; the file is replaced as a whole.

    Formats in single precision hold coordinates relative to the offset if original ones would lose
    digits, and record the offset. LAS and LAZ hold map coordinates.

    Parameters
    ----------
    path : a file with one of SUFFIXES.
    comments : lines for the formats that have a place for text.
    up : float64[3], the unit vector that points up, for the formats that have a place for it.
    georeference : of the original coordinates, likewise.

    Raises
    ------
    InputError : the suffix is unknown or read only, the format cannot hold these gaussians, or the
        file cannot be written.
    """
    path = Path(path)
    notes = Notes(tuple(comments), None if up is None else np.asarray(up, np.float64), georeference)
    write = written_format(path).write
    assert write is not None
    write(path, gaussians, notes)


def read_notes(path: str | Path) -> Notes:
    """What a file of a model holds besides its gaussians: how it was trained, what is up, and its
    georeference, as far as its format has a place for them; raises as `read_model`."""
    return _stored_format(path).notes(Path(path))


def is_model(path: str | Path) -> bool:
    """Whether a path is one that `read_model` may read; else it is a run's folder."""
    path = Path(path)
    return not path.is_dir() or is_unbundled(path)


def written_format(path: str | Path) -> Format:
    """The format of a file that is written; InputError if its suffix is unknown or read only."""
    if Path(path).name.lower().endswith(".compressed.ply"):
        raise InputError(f"{path}: compressed PLY is only read; write .sog or .spz, which are "
                         "smaller, or .ply")
    return _format_of(path, FORMATS)


def _stored_format(path: str | Path) -> Format:
    """The format of a file that is read."""
    return FORMATS[".sog"] if is_unbundled(Path(path)) else _format_of(path, READ)


def _format_of(path: str | Path, formats: Mapping[str, Format]) -> Format:
    name = Path(path).name.lower()
    for suffix, kind in formats.items():
        if name.endswith(suffix):
            return kind
    known = "; ".join(f"{suffix} ({kind.what})" for suffix, kind in formats.items())
    raise InputError(f"{path}: unknown suffix '{Path(path).suffix}'; known: {known}")
