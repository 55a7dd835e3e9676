"""Images beside photos with a value for each of their pixels: masks and depth maps.

Such an image is FOLDER/NAME.png or FOLDER/NAME.jpg.png (as COLMAP names masks) for the photo
NAME.jpg. It may have another size than the photo, but the same shape.
"""

from collections.abc import Sequence
from pathlib import Path, PurePosixPath

from clsplat.errors import InputError
from clsplat.io.photos.images import image_size
from clsplat.scene import View

TOLERANCE = 0.02  # of the ratio of the sides of an image and its photo


def file_beside(folder: Path, view: View, suffixes: Sequence[str] = (".png",)) -> Path | None:
    """The image that a folder has for the photo of a view; None: it has none.

    Parameters
    ----------
    suffixes : that its name may have, the first that exists is used.
    """
    names = [view.name]
    if isinstance(view.source, Path):  # whose name differs for the faces of a cube
        names.append(str(PurePosixPath(view.name).with_name(view.source.name)))
    return next(filter(None, (image_beside(folder, name, suffixes) for name in names)), None)


def image_beside(folder: Path, name: str, suffixes: Sequence[str] = (".png",)) -> Path | None:
    """As `file_beside`, for a photo of this name."""
    stems = name, str(PurePosixPath(name).with_suffix(""))
    paths = (folder / f"{stem}{suffix}" for stem in stems for suffix in suffixes)
    return next((path for path in paths if path.is_file()), None)


def photo_size(view: View) -> tuple[int, int]:
    """(width, height) of the photo of a view as it is stored, pixels."""
    return view.lens.size if view.lens else image_size(view.source)


def check_shape(name: str | Path, kind: str, size: tuple[int, int], photo: tuple[int, int]) -> None:
    """Check that an image beside a photo has its shape.

    Parameters
    ----------
    name, kind : of the image, for the message.
    size, photo : (width, height) of the image and of the photo, pixels.
    """
    if abs(size[0] * photo[1] / (size[1] * photo[0]) - 1) > TOLERANCE:
        raise InputError(f"{name}: the {kind} has {size[0]}x{size[1]} pixels and its photo "
                         f"{photo[0]}x{photo[1]}; make it for this photo")
