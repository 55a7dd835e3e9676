"""Photos that OpenImageIO's wheel does not read: HEIC, by pillow-heif, and camera RAW, by rawpy.

Both are packages of the extra photos, and decode a photo as a whole. OpenImageIO reads the metadata
of these photos too, from a PNG of one pixel that gets them.
"""

import io
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from clsplat.io.regular import open_regular

HEIC_SUFFIXES = (".heic", ".heif", ".hif")
RAW_SUFFIXES = (".dng", ".cr2", ".cr3", ".nef", ".arw", ".orf", ".raf", ".rw2", ".pef", ".srw")
BRANDS = (b"heic", b"heix", b"heim", b"heis", b"hevc", b"hevx", b"mif1", b"msf1")  # of HEIC
# photos of a scene keep their names, whatever their format: what a file of such a name may be
RENDERED = (b"\xff\xd8\xff", b"\x89PNG")
ORIENTATIONS = {3: 3, 5: 8, 6: 6}  # of EXIF, by LibRaw's number of the turn
# the same for all photos of a set: LibRaw would else choose brightness and white for each
DEVELOPED = {
    "use_camera_wb": True,
    "no_auto_bright": True,
    "adjust_maximum_thr": 0.0,
    "user_flip": 0,
    "gamma": (2.4, 12.92),
    "output_bps": 8,
}  # gamma: that of sRGB
# what metadata.py reads of a TIFF, which camera RAW mostly is: the tags of each directory
XMP, EXIF_IFD, GPS_IFD = 700, 34665, 34853
TAGS = (271, 272)
IFD_TAGS = {
    EXIF_IFD: (37386, 40962, 40963, 41486, 41487, 41488, 41989, 42033, 42036),
    GPS_IFD: (1, 2, 3, 4, 5, 6, 9, 31),
}
TIFF = {b"II": b"II*\0", b"MM": b"MM\0*"}  # some makers have numbers of their own there
FUJI = b"FUJI"
# about tags that a maker writes in a way of its own
warnings.filterwarnings("ignore", category=UserWarning, module=r"PIL\.TiffImagePlugin")


class Decoded(NamedTuple):
    """A photo that is decoded as a whole."""

    width: int
    height: int
    channels: int  # grey or colours, and alpha
    stored: int  # bytes of the file
    orientation: int  # of EXIF, that the decoder leaves to do
    pixels: Callable[[], NDArray[np.uint8]]  # [height, width, channels]
    header: Callable[[], bytes]  # an image with its EXIF and XMP
    profile: bytes = b""  # of its colours


def decoded(source: str | Path | bytes) -> Decoded | None:
    """Open a photo in HEIC, by its content, or in camera RAW, by its suffix; None: it is neither.

    ImportError without the package that reads it, OSError or another error if it is damaged.
    """
    with io.BytesIO(source) if isinstance(source, bytes) else open_regular(source) as file:
        head, size = file.read(12), file.seek(0, io.SEEK_END)
    if head[4:8] == b"ftyp" and head[8:] in BRANDS:
        return _heic(source, size)
    if isinstance(source, bytes) or head.startswith(RENDERED) or (Path(source).suffix.lower() not in RAW_SUFFIXES):
        return None
    return _raw(Path(source), size)


def _library(name: str, package: str, what: str) -> Any:
    try:
        return import_module(name)
    except ImportError:
        raise ImportError(f"{what} needs {package}, of the extra photos; `pip install pillow-heif rawpy`") from None


def _heic(source: str | Path | bytes, size: int) -> Decoded:
    """libheif turns the pixels as the file asks, so that EXIF's orientation is done."""
    read = _library("pillow_heif", "pillow-heif", "HEIC").open_heif
    heif = read(source)  # it holds the file, and who reads headers keeps many photos
    exif, xmp, profile = (heif.info.get(key) or b"" for key in ("exif", "xmp", "icc_profile"))
    width, height = heif.size
    # copied: in some versions of pillow-heif they are memory that goes with the file
    return Decoded(
        width, height, len(heif.mode), size, 1, lambda: np.array(read(source)), lambda: _image_with(exif, xmp), profile
    )


@contextmanager
def _raw_file(path: Path) -> Iterator[Any]:
    rawpy = _library("rawpy", "rawpy", "camera RAW")
    try:
        with rawpy.RawPy() as raw:
            raw.open_file(str(path))
            yield raw
    except rawpy.LibRawError as error:  # whose text is bytes
        raise ValueError(error.args[0].decode(errors="replace")) from None


def _raw(path: Path, size: int) -> Decoded:
    def pixels() -> NDArray[np.uint8]:
        with _raw_file(path) as raw:
            return np.asarray(raw.postprocess(**DEVELOPED))

    with _raw_file(path) as raw:
        sizes = raw.sizes
    return Decoded(
        sizes.iwidth, sizes.iheight, 3, size, ORIENTATIONS.get(sizes.flip, 1), pixels, lambda: _raw_header(path)
    )


def _raw_header(path: Path) -> bytes:
    """An image with the metadata of camera RAW: those of a TIFF, or of the JPEG that Fuji's files
    begin with; CR3 is neither."""
    from PIL import Image

    data = path.read_bytes()
    if data.startswith(FUJI):
        data = data[data.find(RENDERED[0]) :]
        data = data[data.find(b"Exif\0\0") + 6 :]
    if data[:2] not in TIFF:
        return _image_with(b"", b"")
    found, kept = Image.Exif(), Image.Exif()
    found.load(TIFF[data[:2]] + data[4:])
    kept.update({tag: found[tag] for tag in TAGS if tag in found})
    for ifd, tags in IFD_TAGS.items():
        values = found.get_ifd(ifd)
        kept.get_ifd(ifd).update({tag: values[tag] for tag in tags if tag in values})
    return _image_with(kept.tobytes(), found.get(XMP, b""))


def _image_with(exif: bytes, xmp: bytes) -> bytes:
    from PIL import Image, PngImagePlugin

    texts, file = PngImagePlugin.PngInfo(), io.BytesIO()
    if xmp:
        texts.add_itxt("XML:com.adobe.xmp", xmp.decode(errors="replace"))
    Image.new("L", (1, 1)).save(file, "PNG", exif=exif, pnginfo=texts)
    return file.getvalue()
