"""One photo that is open: what its header says, and its pixels a few rows at a time.

docs/guide/photos.md has the table of what is read.
"""

from contextlib import contextmanager

import numpy as np

from clsplat.errors import InputError
from clsplat.io.reason import LONGEST
from clsplat.io.regular import memory_file, open_regular, utf8_path
from clsplat.io.resample import band_rows

# a header that claims more is damaged: no decoder may allocate for it
LARGEST_PIXELS = 1 << 30
PIXELS_PER_BYTE = 1 << 13  # deflate's limit, for samples of one bit
FORMATS = ("jpeg", "png", "tiff", "webp", "bmp", "gif", "jpeg2000", "jpegxl", "openexr", "hdr",
           "pnm", "targa")
CONVERT = "convert it to JPEG or PNG"
# TIFF's PhotometricInterpretation: white is zero, black is zero, RGB, palette, CMYK, YCbCr
COLOUR_MODELS = (0, 1, 2, 3, 5, 6)
FLOATS = ("half", "float")
LUMINANCE, LIGHT = ("Y", "I", "L"), ("openexr", "hdr")


class Photo:
    """A photo whose header was read; see `opened`.

    name: for messages; width, height: pixels as stored; orientation: EXIF's number, 1 where there
    is none; linear: its samples are linear light; has_alpha; extra: channels beyond colour and
    alpha.
    """

    def __init__(self, name, image):
        self.name, self._image, self._spec = name, image, image.spec()
        spec = self._spec
        self.width, self.height = spec.width, spec.height
        self.orientation = spec.get_int_attribute("Orientation", 1)
        self._channels = _colour_channels(spec, image.format_name(), name)
        space = spec.get_string_attribute("oiio:ColorSpace").lower()
        deep = str(spec.format) in FLOATS
        self.linear = space.startswith("lin") or (deep and not space.startswith("srgb"))
        # every GIF is read with alpha
        self.has_alpha = spec.alpha_channel >= 0 and image.format_name() != "gif"
        self.extra = spec.nchannels - len(set(self._channels)) - (spec.alpha_channel >= 0)

    def bands(self, top=0, bottom=None):
        """Yields uint8[n, W, 3], rows `top` to `bottom` from the top down, as sRGB."""
        spec, bottom = self._spec, self.height if bottom is None else bottom
        # OpenImageIO refuses parts of tiles, and takes wrong rows for parts of some TIFFs' strips
        unit = spec.tile_height or spec.get_int_attribute("tiff:RowsPerStrip", 1)
        unit = min(max(unit, 1), self.height)
        step = max(1, band_rows(self.width, spec.nchannels) // unit) * unit
        for row in range(top // unit * unit, bottom, step):
            end = min(row + step, -(-bottom // unit) * unit, self.height)
            pixels = self._colours(self._rows(row, end))
            yield pixels[max(0, top - row):bottom - row]

    def _rows(self, begin, end):
        """Samples [end - begin, W, channels], float32 of linear light, else uint8."""
        spec, kind = self._spec, "float" if self.linear else "uint8"
        low, high, channels = spec.y + begin, spec.y + end, spec.nchannels
        if spec.tile_width:
            pixels = self._image.read_tiles(spec.x, spec.x + spec.width, low, high, spec.z,
                                            spec.z + max(1, spec.depth), 0, channels, kind)
        else:
            pixels = self._image.read_scanlines(low, high, spec.z, 0, channels, kind)
        # a JPEG cut short is filled with grey and only leaves a message behind
        reason = reason_of(self._image)
        if pixels is None or reason:
            raise InputError(f"{self.name}: the image is damaged or cut short ({reason}); "
                             f"copy it again, or {CONVERT}")
        return pixels.reshape(end - begin, spec.width, channels)

    def _colours(self, samples):
        samples = samples[..., list(self._channels)]
        if not self.linear:
            return samples
        missing = np.count_nonzero(np.isnan(samples))
        if missing:
            raise InputError(f"{self.name}: {missing} of its samples are not numbers (NaN); "
                             "export it again without them")
        light = np.clip(samples, 0, 1)
        shown = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
        return (shown * 255 + 0.5).astype(np.uint8)


def _colour_channels(spec, kind, name):
    """Which of the channels are red, green and blue."""
    if spec.get_int_attribute("tiff:PhotometricInterpretation", 2) not in COLOUR_MODELS:
        model = spec.get_string_attribute("tiff:ColorSpace") or "another colour model"
        raise InputError(f"{name}: a TIFF in {model}, whose colours are not read; "
                         "convert it to RGB")
    if str(spec.format) == "double":  # OpenImageIO 3.2 takes wrong rows of many of these
        raise InputError(f"{name}: samples of 64 bits are not read; convert it to 32 or 16 bits")
    names = [channel.rpartition(".")[2].upper() for channel in spec.channelnames]
    if all(colour in names for colour in "RGB"):
        return tuple(names.index(colour) for colour in "RGB")
    if kind in LIGHT and (names[0] not in LUMINANCE or {"RY", "BY"} & set(names)):
        raise InputError(f"{name}: its channels are {', '.join(spec.channelnames)[:80]}, not red, "
                         "green and blue; export it as RGB")
    return (0, 1, 2) if spec.nchannels > 2 and kind not in LIGHT else (0, 0, 0)


@contextmanager
def opened(source):
    """The Photo of a Path, or of the encoded bytes of one; InputError where it is none."""
    if isinstance(source, bytes):
        name = f"packed image of {len(source)} bytes"
        with memory_file(name, source) as path:
            yield from _opened(path, name, len(source))
        return
    try:
        with open_regular(source) as file:
            size = file.seek(0, 2)
    except FileNotFoundError:
        raise InputError(f"{source}: no such image; check the path") from None
    except (OSError, ValueError) as error:
        why = getattr(error, "strerror", None) or str(error)
        raise InputError(f"{str(source)[:LONGEST]}: the image cannot be read ({why}); check the "
                         "path") from None
    with utf8_path(source) as path:
        yield from _opened(path, source, size)


def _opened(path, name, size):
    import OpenImageIO as oiio

    config = oiio.ImageSpec()
    config.attribute("oiio:UnassociatedAlpha", 1)  # keep colours as stored, whatever their alpha
    image = oiio.ImageInput.open(path, config)
    reason = reason_of(oiio)
    if image is None:
        raise InputError(f"{name}: not an image that can be read ({reason}); "
                         f"copy it again, or {CONVERT}")
    try:
        if image.format_name() not in FORMATS:
            raise InputError(f"{name}: photos in the format {image.format_name()} are not read; "
                             f"{CONVERT}")
        spec = image.spec()
        if not 0 < spec.width * spec.height <= min(LARGEST_PIXELS, PIXELS_PER_BYTE * size):
            raise InputError(f"{name}: damaged: its header claims {spec.width}x{spec.height} "
                             "pixels; copy it again")
        try:
            yield Photo(name, image)
        except MemoryError:
            raise InputError(f"{name}: {spec.width}x{spec.height} pixels need more memory than "
                             "there is; free some, or make the photos smaller") from None
    finally:
        image.close()


def reason_of(library):
    """The first line of what OpenImageIO last complained about, or an empty string."""
    return next(iter(library.geterror().splitlines()), "")
