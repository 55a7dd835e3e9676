"""An open photo: its header, and its pixels a few rows at a time.

docs/guide/photos.md has a table of the formats that are read.
"""

import functools
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.errors import InputError, clean
from clsplat.io.fields import reading
from clsplat.io.photos.decoded import Decoded, decoded
from clsplat.io.photos.profiles import converted, to_srgb
from clsplat.io.photos.resample import band_rows
from clsplat.io.regular import open_regular

# a header that claims more pixels is damaged: no decoder may allocate memory for it
MOST_PIXELS = 1 << 30
PIXELS_PER_BYTE = 1 << 13  # deflate's limit, for samples of one bit
FORMATS = (
    "jpeg",
    "png",
    "tiff",
    "webp",
    "bmp",
    "gif",
    "jpeg2000",
    "jpegxl",
    "openexr",
    "pnm",
    "targa",
)  # openexr: depth maps
CONVERT = "convert it to JPEG or PNG"
# TIFF's PhotometricInterpretation: white is zero, black is zero, RGB, palette, CMYK, YCbCr
COLOUR_MODELS = (0, 1, 2, 3, 5, 6)
FLOAT_SAMPLES = ("half", "float")
MOST_READ = 32  # photos, evenly chosen, whose samples decide the levels
SHARES = (0.1, 99.9)  # per cent of a photo's samples, between which they count
FEWEST_STEPS = 64.0  # of 8 bits that samples fill, with which they are left as they are
Levels = tuple[float, float]  # samples of 16 bits that become black and white
Source = str | Path | bytes | NDArray[Any]  # a file, an encoded photo, or pixels: see `opened`


class Photo:
    """A photo whose header was read; see `opened`.

    `name` is for messages; `width` and `height` are pixels as stored; `orientation` is EXIF's
    number, 1 without one; `extra` is how many channels there are beyond colour and alpha. A photo
    that `is_deep` is grey, with samples of 16 bits, of which `levels` become black and white; None:
    the least and the greatest of all. `to_srgb` converts its colours, if they have another profile;
    `has_unused_profile`: they have one that is damaged or for other channels.
    """

    to_srgb: Any = None
    has_unused_profile = False

    def __init__(self, name: str | Path, image: Any) -> None:
        self.name, self._image, self._spec = name, image, image.spec()
        spec, kind = self._spec, image.format_name()
        self.width: int = spec.width
        self.height: int = spec.height
        self.orientation: int = spec.get_int_attribute("Orientation", 1)
        self._channels = _colour_channels(spec, name)
        self._alpha: int = spec.alpha_channel
        self.has_alpha: bool = self._alpha >= 0 and kind != "gif"  # each GIF is read with it
        self.is_deep: bool = str(spec.format) == "uint16" and len(set(self._channels)) == 1
        self.levels: Levels | None = None
        self.extra: int = spec.nchannels - len(set(self._channels)) - (self._alpha >= 0)
        profile = spec.getattribute("ICCProfile")
        self._use_profile(b"" if profile is None else np.asarray(profile, np.uint8).tobytes())

    def _use_profile(self, profile: bytes) -> None:
        if profile:
            try:
                if len(set(self._channels)) == 1:
                    raise ValueError("it is grey")
                self.to_srgb = to_srgb(profile)
            except ValueError:
                self.has_unused_profile = True

    def attribute(self, name: str) -> object:
        """The value of an entry of the header by OpenImageIO's name, such as "Exif:FocalLength":
        a number, a text or a tuple of numbers; None if there is no such entry."""
        return self._spec.getattribute(name)

    def bands(self, top: int, bottom: int) -> Iterator[NDArray[np.uint8]]:
        """Yield the rows from `top` to `bottom` in order, uint8[n, W, 3], sRGB."""
        for samples in self._bands(top, bottom, "uint16" if self.levels else "uint8"):
            # a list of channels copies them one after the other, and who reads rows copies again
            pixels = samples[..., :3] if self._channels == (0, 1, 2) else samples[..., list(self._channels)]
            if self.levels:
                low, high = self.levels
                grey = (pixels - np.float32(low)) * np.float32(255 / (high - low))
                pixels = (np.clip(grey, 0, 255) + np.float32(0.5)).astype(np.uint8)
            if self.to_srgb is not None:
                pixels = converted(pixels, self.to_srgb)
            yield pixels

    def samples(self) -> NDArray[np.uint16]:
        """The grey samples of a deep photo, uint16[H, W]."""
        return np.concatenate([rows[..., self._channels[0]] for rows in self._bands(0, self.height, "uint16")])

    def alpha(self) -> NDArray[np.uint8]:
        """The alpha channel, uint8[H, W]; the photo must have one."""
        return np.concatenate([rows[..., self._alpha].copy() for rows in self._bands(0, self.height, "uint8")])

    def _bands(self, top: int, bottom: int, kind: str) -> Iterator[NDArray[Any]]:
        """Samples [n, W, channels] of a kind, "uint8" or "uint16"."""
        spec = self._spec
        # OpenImageIO refuses parts of tiles, and reads wrong rows for parts of some TIFFs' strips
        unit = spec.tile_height or spec.get_int_attribute("tiff:RowsPerStrip", 1)
        unit = min(max(unit, 1), self.height)
        step = max(1, band_rows(self.width, spec.nchannels) // unit) * unit
        for row in range(top // unit * unit, bottom, step):
            end = min(row + step, -(-bottom // unit) * unit, self.height)
            yield self._rows(row, end, kind)[max(0, top - row) : bottom - row]

    def _rows(self, begin: int, end: int, kind: str) -> NDArray[Any]:
        spec = self._spec
        low, high, channels = spec.y + begin, spec.y + end, spec.nchannels
        if spec.tile_width:
            pixels = self._image.read_tiles(
                spec.x, spec.x + spec.width, low, high, spec.z, spec.z + max(1, spec.depth), 0, channels, kind
            )
        else:
            pixels = self._image.read_scanlines(low, high, spec.z, 0, channels, kind)
        return _whole(self.name, self._image, pixels).reshape(end - begin, spec.width, channels)


def _whole(name: str | Path, image: Any, pixels: NDArray[Any] | None) -> NDArray[Any]:
    """The samples that OpenImageIO has read; InputError if it could not read all of them."""
    reason = reason_of(image)  # a truncated JPEG is filled with grey and only leaves a message
    if pixels is None or reason:
        raise InputError(f"{name}: the image is damaged or cut short ({reason}); copy it again, or {CONVERT}")
    return pixels


def _colour_channels(spec: Any, name: str | Path) -> tuple[int, int, int]:
    """The indices of the red, green and blue channels."""
    if spec.get_int_attribute("tiff:PhotometricInterpretation", 2) not in COLOUR_MODELS:
        model = spec.get_string_attribute("tiff:ColorSpace") or "another colour model"
        raise InputError(f"{name}: a TIFF in {model}, whose colours are not read; convert it to RGB")
    if str(spec.format) in (*FLOAT_SAMPLES, "double"):
        raise InputError(f"{name}: photos with floating point samples, such as EXR, are not read; {CONVERT}")
    names = [channel.rpartition(".")[2].upper() for channel in spec.channelnames]
    if all(colour in names for colour in "RGB"):
        return names.index("R"), names.index("G"), names.index("B")
    return (0, 1, 2) if spec.nchannels > 2 else (0, 0, 0)


class _ArrayPhoto(Photo):
    """Pixels in memory; see `opened`."""

    def __init__(self, pixels: NDArray[Any]) -> None:
        if (
            pixels.ndim not in (2, 3)
            or pixels.dtype not in (np.uint8, np.uint16, np.float32)
            or (pixels.ndim == 3 and not 1 <= pixels.shape[2] <= 4)
            or not pixels.size
        ):
            raise InputError(f"a photo is {pixels.dtype}{list(pixels.shape)}; give uint8, uint16 or float32 [H, W, 3]")
        self._pixels = pixels.reshape(*pixels.shape[:2], -1)
        self._describe(f"array {list(pixels.shape)}", *self._pixels.shape)
        self.is_deep = pixels.dtype == np.uint16 and self._channels == (0, 0, 0)

    def _describe(self, name: str | Path, height: int, width: int, channels: int) -> None:
        self.name, self.height, self.width = name, height, width
        self.orientation, self.extra, self.levels, self.is_deep = 1, 0, None, False
        self._channels = (0, 1, 2) if channels > 2 else (0, 0, 0)
        self._alpha, self.has_alpha = channels - 1, channels in (2, 4)

    def _bands(self, top: int, bottom: int, kind: str) -> Iterator[NDArray[Any]]:
        pixels = self._pixels
        step = band_rows(self.width, pixels.shape[2])
        for row in range(top, bottom, step):
            rows = pixels[row : min(row + step, bottom)]
            if rows.dtype != kind:
                whole = 1.0 if rows.dtype == np.float32 else np.iinfo(rows.dtype).max
                scaled = np.clip(np.nan_to_num(rows), 0, whole) * (np.iinfo(kind).max / whole)
                rows = (scaled + 0.5).astype(kind)
            yield rows


class _DecodedPhoto(_ArrayPhoto):
    """A photo that is decoded as a whole, when its pixels or its metadata are first read."""

    def __init__(self, name: str | Path, found: Decoded) -> None:
        _check_claim(name, found.width, found.height, found.stored)
        self._found = found
        self._describe(name, found.height, found.width, found.channels)
        self.orientation = found.orientation
        self._use_profile(found.profile)

    @functools.cached_property
    def _pixels(self) -> NDArray[np.uint8]:  # type: ignore[override]
        with _decoding(self.name):
            pixels = self._found.pixels()
            if pixels.shape[:2] != (self.height, self.width):
                raise ValueError("its pixels have another size than its header says")
        return pixels.reshape(self.height, self.width, -1)

    @functools.cached_property
    def _spec(self) -> Any:
        with _decoding(self.name):
            header = self._found.header()
        with _input(header, self.name) as (_, image):
            return image.spec()


def _encoded(source: bytes) -> str:
    """The name of an encoded photo for messages."""
    return f"encoded image of {len(source)} bytes"


def _check_claim(name: str | Path, width: int, height: int, stored: int) -> None:
    """InputError if a header claims more pixels than the stored bytes may hold."""
    if not 0 < width * height <= min(MOST_PIXELS, PIXELS_PER_BYTE * stored):
        raise InputError(f"{name}: damaged: its header claims {width}x{height} pixels; copy it again")


def _decoding(name: str | Path) -> AbstractContextManager[None]:
    return reading(name, "an image that can be read", f"copy it again, or {CONVERT}")


@contextmanager
def opened(source: Source) -> Iterator[Photo]:
    """Open a photo; InputError if it is none.

    Parameters
    ----------
    source : a path, encoded bytes, or an array uint8, uint16 or float32 [H, W] or [H, W, C], sRGB,
        floats in 0 to 1. One channel is grey; a second or a fourth one is alpha.
    """
    if isinstance(source, np.ndarray):
        yield _ArrayPhoto(source)
        return
    name = _encoded(source) if isinstance(source, bytes) else source
    with _decoding(name):
        found = decoded(source)
    if found is not None:
        yield _DecodedPhoto(name, found)
        return
    with _input(source) as (name, image):
        yield Photo(name, image)


def first_channel(path: Path) -> NDArray[Any]:
    """Read the first channel of an image of depths, uint16[H, W] or float32[H, W]."""
    with _input(path) as (name, image):
        kind = str(image.spec().format)
        if kind not in ("uint16", *FLOAT_SAMPLES):
            raise InputError(
                f"{name}: has samples of {kind}; depth maps have 16 bits (millimetres) or floats (the scene's units)"
            )
        pixels = image.read_image(0, 0, 0, 1, "uint16" if kind == "uint16" else "float")
        return _whole(name, image, pixels)[..., 0]


def common_levels(sources: Sequence[Source], deep: Sequence[bool]) -> tuple[list[Levels | None], list[str]]:
    """For each photo the lowest and the greatest sample that count in the whole set, so that a
    surface keeps its grey from view to view; None for those that are read as they are. And notes.

    Temperatures of a thermal camera fill a hundredth of what 16 bits hold: divided by 257, they
    would be four levels of grey.

    Parameters
    ----------
    sources, deep : of photos, as `opened` takes them; and whether each is grey with 16 bits.
    """
    read = [source for source, is_deep in zip(sources, deep) if is_deep]
    ends = []
    for source in read[:: -(-len(read) // MOST_READ) or 1]:
        with opened(source) as photo:
            ends.append(np.percentile(photo.samples(), SHARES))
    low, high = (float(np.min(ends)), float(np.max(ends))) if ends else (0.0, 0.0)
    if not 0 < high - low < 257 * FEWEST_STEPS:
        return [None] * len(deep), []
    return [(low, high) if is_deep else None for is_deep in deep], [
        f"{len(read)} of {len(deep)} photos are grey with 16 bits, of which they use {low:.0f} to "
        f"{high:.0f}: all are stretched alike to 8 bits"
    ]


@contextmanager
def _input(source: str | Path | bytes, name: str | Path = "") -> Iterator[tuple[str | Path, Any]]:
    """The name of an image for messages, and OpenImageIO's input of it."""
    import OpenImageIO as oiio

    if isinstance(source, bytes):  # OpenImageIO does not read Python's memory
        with tempfile.TemporaryDirectory(prefix="clsplat-") as folder:
            path = Path(folder, "image")
            path.write_bytes(source)
            with _input(path, name or _encoded(source)) as found:
                yield found
        return
    name, path = name or source, Path(source)
    with _decoding(path):
        with open_regular(path) as file:
            size = file.seek(0, 2)
    if str(path).encode(errors="replace").decode() != str(path):  # OpenImageIO takes no other
        raise InputError(f"{path}: the path of the image is not UTF-8; rename it")
    config = oiio.ImageSpec()
    config.attribute("oiio:UnassociatedAlpha", 1)  # keep colours as stored, whatever their alpha
    image = oiio.ImageInput.open(str(path), config)
    reason = reason_of(oiio)
    if image is None:
        raise InputError(f"{name}: not an image that can be read ({reason}); copy it again, or {CONVERT}")
    try:
        if image.format_name() not in FORMATS:
            raise InputError(f"{name}: photos in the format {image.format_name()} are not read; {CONVERT}")
        spec = image.spec()
        _check_claim(name, spec.width, spec.height, size)
        try:
            yield name, image
        except MemoryError:
            raise InputError(
                f"{name}: not enough memory for {spec.width}x{spec.height} pixels; "
                "free some, or make the photos smaller"
            ) from None
    finally:
        image.close()


def reason_of(library: Any) -> str:
    """The first line of the last error of OpenImageIO or of one of its files, or an empty string."""
    try:
        text = library.geterror()
    except UnicodeDecodeError as error:  # it quotes the names in a damaged file
        text = error.object.decode(errors="replace")
    return clean(next(iter(text.splitlines()), ""))
