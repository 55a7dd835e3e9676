"""The place and the orientation of a scene on disk, in the folder of a scene or of a run.

georeference.json has the attributes of `Georeference`, and for other programs what follows from its
residuals. orientation.json has `up`, a unit vector, and in a run folder `first_view`, a camera;
both are in original coordinates.
"""

import math
from collections.abc import Callable, Iterable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from clsplat.camera import Camera
from clsplat.georeference import CHECK, CONTROL, LEFT_OUT, Georeference, Residual
from clsplat.io.fields import number, numbers, pixels, reading, table, tables, text
from clsplat.io.records import object_of, write_object
from clsplat.io.regular import read_regular
from clsplat.scene import Scene

GEOREFERENCE, ORIENTATION = "georeference.json", "orientation.json"
CRS_COMMENT, OFFSET_COMMENT = "crs ", "map_offset "
UP_COMMENT, AXIS_COMMENT = "up ", "Vertical Axis: "
ALONG_AXIS = 0.99  # cosine: about 8 degrees from an axis, which nerfstudio and Brush write, too
T = TypeVar("T")


def write_georeference(folder: str | Path, georeference: Georeference | None) -> None:
    """Replace georeference.json in a folder; None removes what an earlier scene left there."""
    path = Path(folder) / GEOREFERENCE
    if georeference is None:
        path.unlink(missing_ok=True)
    else:
        write_object(path, georeference_record(georeference), indent=2)


def read_georeference(folder: str | Path) -> Georeference | None:
    """Read georeference.json of a folder; None if it has none, InputError if it is damaged."""
    return _read(Path(folder) / GEOREFERENCE, georeference_of)


def _read(path: Path, parsed: Callable[[dict[str, Any]], T]) -> T | None:
    """What a function makes of the record in a file; None without the file."""
    if not path.exists():
        return None
    with reading(path, "a record of clsplat", "correct the file, or remove it and georeference the scene again"):
        return parsed(object_of(read_regular(path)))


def georeference_record(known: Georeference) -> dict[str, Any]:
    """The record of georeference.json: the attributes, and by role how many places there are
    (`control_count`, `check_count`), the names of those left out, and errors by axis."""
    return {
        **asdict(known),
        "control_count": len(known.names(CONTROL)),
        "check_count": len(known.names(CHECK)),
        "left_out": list(known.names(LEFT_OUT)),
        **{
            f"{role}_errors": {axis: asdict(error) for axis, error in known.errors(role).items()}
            for role in (CONTROL, CHECK)
        },
    }


def georeference_of(record: dict[str, Any]) -> Georeference:
    """The georeference of a record of JSON; ValueError names the fault. Records of older
    versions lack most keys."""
    crs = text(record.get("crs"), "crs")
    if not crs.strip():
        raise ValueError("crs is empty")
    east, north, height = numbers(record.get("offset"), 3, "offset").tolist()
    warnings = record.get("warnings", [])
    if not isinstance(warnings, list):
        raise ValueError("warnings are not a list of texts")
    source, kind, vertical = (text(record.get(key, ""), key) for key in ("source", "kind", "vertical"))
    residual, size = (number(record.get(key, 0.0), key) for key in ("residual", "size"))
    return Georeference(
        crs,
        (east, north, height),
        source,
        residual,
        kind,
        size,
        vertical,
        tuple(map(_residual, tables(record.get("residuals", []), "residuals"))),
        tuple(text(each, "a warning") for each in warnings),
    )


def _residual(row: dict[str, Any]) -> Residual:
    up, pixel = (None if row.get(key) is None else number(row[key], key) for key in ("up", "pixels"))
    return Residual(
        text(row.get("name", ""), "name"),
        text(row.get("role", ""), "role"),
        number(row.get("east"), "east"),
        number(row.get("north"), "north"),
        up,
        pixel,
    )


def write_orientation(folder: str | Path, up: ArrayLike, first_view: Camera | None = None) -> None:
    """Replace orientation.json in a folder.

    Parameters
    ----------
    up : [3], the unit vector that points up.
    first_view : of a viewer, in coordinates whose origin is its `offset`; None: not recorded.
    """
    record: dict[str, Any] = {"up": np.asarray(up, np.float64).tolist()}
    if first_view is not None:
        camera = first_view.shifted(-first_view.offset)
        record["first_view"] = {
            name: np.asarray(getattr(camera, name)).tolist()
            for name in ("width", "height", "focal", "centre", "rotation", "translation")
        }
    write_object(Path(folder) / ORIENTATION, record, indent=2)


def read_orientation(folder: str | Path) -> tuple[NDArray[np.float64], Camera | None] | None:
    """Read orientation.json of a folder: the unit vector that points up and the first view, if it
    is recorded, in original coordinates; None if there is no such file."""

    def parsed(record: dict[str, Any]) -> tuple[NDArray[np.float64], Camera | None]:
        view = record.get("first_view")
        return (_unit(numbers(record.get("up"), 3, "up")), None if view is None else _camera(table(view, "first_view")))

    return _read(Path(folder) / ORIENTATION, parsed)


def _unit(vector: NDArray[np.float64]) -> NDArray[np.float64]:
    length = float(np.linalg.norm(vector))
    if not 0 < length < math.inf:
        raise ValueError("up has no direction")
    return vector / length


def write_placement(folder: str | Path, scene: Scene, first_view: bool = False) -> None:
    """Write the place and the orientation of a scene into a folder, on request with the first view;
    what an earlier scene left there is replaced or removed."""
    write_orientation(folder, scene.up, scene.first_view if first_view else None)
    write_georeference(folder, scene.georeference)


def placed(scene: Scene, folder: str | Path) -> Scene:
    """Add what the files of its folder hold about the place and the orientation of a scene."""
    orientation = read_orientation(folder)
    return replace(
        scene,
        georeference=read_georeference(folder) or scene.georeference,
        given_up=scene.given_up if orientation is None else orientation[0],
    )


def placement_comments(up: ArrayLike, georeference: Georeference | None = None) -> tuple[str, ...]:
    """Lines for the header of a model's file, in every format with room for text: which way is up,
    a unit vector in the axes of the file, and where its coordinates lie, if that is known.

    The offset is said not to be contained in the positions, so that no reader adds it twice, or not
    at all.
    """
    vector = np.asarray(up, np.float64)
    lines = [UP_COMMENT + " ".join(f"{value:.9g}" for value in vector)]
    axis = int(np.argmax(np.abs(vector)))
    if vector[axis] > ALONG_AXIS:
        lines.append(AXIS_COMMENT + "xyz"[axis])
    if georeference is not None:
        crs = georeference.crs.encode("unicode_escape").decode()
        offset = " ".join(repr(float(value)) for value in georeference.offset)
        lines += [
            CRS_COMMENT + crs,
            f"{OFFSET_COMMENT}{offset} is not contained in the positions: map coordinates are positions + map_offset",
        ]
    return tuple(lines)


def commented_georeference(comments: Iterable[str]) -> Georeference | None:
    """The georeference that `placement_comments` wrote into the comments of a file, or None."""
    texts = {
        key: comment.removeprefix(key)
        for comment in comments
        for key in (CRS_COMMENT, OFFSET_COMMENT)
        if comment.startswith(key)
    }
    if len(texts) < 2:
        return None
    try:
        return georeference_of(
            {
                "crs": texts[CRS_COMMENT].encode("ascii").decode("unicode_escape"),
                "offset": " ".join(texts[OFFSET_COMMENT].split()[:3]),
                "source": "comments of the model's file",
            }
        )
    except ValueError:
        return None


def commented_up(comments: Iterable[str]) -> NDArray[np.float64] | None:
    """The unit vector up that `placement_comments` wrote into the comments of a file, or None."""
    for comment in comments:
        if comment.startswith(UP_COMMENT):
            try:
                return _unit(numbers(" ".join(comment.split()[1:4]), 3, "up"))
            except ValueError:
                continue
    return None


def _camera(record: dict[str, Any]) -> Camera:
    width, height = (pixels(record.get(key), key) for key in ("width", "height"))
    (fx, fy), (cx, cy) = (numbers(record.get(key), 2, key).tolist() for key in ("focal", "centre"))
    rotation = np.array([numbers(row, 3, "rotation") for row in record.get("rotation") or ()])
    if not (
        fx > 0
        and fy > 0
        and rotation.shape == (3, 3)
        and np.linalg.det(rotation) > 0
        and np.abs(rotation @ rotation.T - np.eye(3)).max() < 1e-3
    ):
        raise ValueError("first_view is not a camera")
    return Camera(width, height, (fx, fy), (cx, cy), rotation, numbers(record.get("translation"), 3, "translation"))
