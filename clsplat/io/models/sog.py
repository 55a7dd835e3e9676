"""Gaussians as SOG, the format of PlayCanvas: lossless WebP textures in a zip, version 2.

The textures may also lie in a folder, beside meta.json.

Each gaussian is a pixel of every texture. Positions have 16 bits a coordinate, on a scale that is
logarithmic far from the origin; log scales, colours and harmonics are numbers of a codebook of 256;
the harmonics of all gaussians are chosen from a palette.
"""

import json
import zipfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.errors import InputError
from clsplat.gaussians import Gaussians
from clsplat.io.atomic import replacing
from clsplat.io.models.quantise import (
    codebook,
    from_smallest_three,
    morton_order,
    palette,
    smallest_three,
)
from clsplat.io.models.values import (
    MIP,
    Notes,
    byte_logits,
    doubles,
    gaussians_of,
    opacities,
    reading,
    stored_positions,
    to_bytes,
)
from clsplat.io.photos.images import encode_image
from clsplat.io.photos.photo import reason_of, temporary_file
from clsplat.io.records import object_of
from clsplat.io.regular import read_regular
from clsplat.io.unpack import check_expansion, check_rows, opened_archive

META, GENERATOR, ORIGIN = "meta.json", "clsplat", "clsplat_origin"
MEANS, SCALES, QUATERNIONS, COLOURS, HARMONICS = "means", "scales", "quats", "sh0", "shN"
KIND = "a SOG file of version 2"
TEXTURES = {MEANS: 2, QUATERNIONS: 1, COLOURS: 1, SCALES: 1}  # how many files a part has
BANDS = {0: 0, 1: 3, 2: 8, 3: 15}  # harmonics above the constant, by their degree
DATE = (1980, 1, 1, 0, 0, 0)  # of every member, so that equal models give equal bytes
FIRST_TAG = 252  # of the last channel of quaternions: tag + which component is the largest
PALETTE_COLUMNS = 64
# colours of the palette: one a gaussian for small models, one for many gaussians of large ones
FEWEST_COLOURS, MOST_COLOURS, GAUSSIANS_A_COLOUR = 1024, 1 << 13, 32
MOST_MEMBERS = 64  # of a zip
SMALLEST_SPAN = 1e-12


def write_sog(path: Path, gaussians: Gaussians, notes: Notes) -> None:
    """Write gaussians as SOG; see `models.write_model`.

    They are sorted along a curve in space. Of the comments, only whether the model is antialiased
    has a place.
    """
    positions, origin = stored_positions(gaussians)
    order = morton_order(positions)
    rows = doubles(gaussians, order)
    logarithms = _to_logarithm(positions[order])
    low = logarithms.min(axis=0, initial=0 if not len(order) else np.inf)
    high = logarithms.max(axis=0, initial=0 if not len(order) else -np.inf)
    steps = np.rint((logarithms - low) / np.maximum(high - low, SMALLEST_SPAN) * 65535).astype(int)
    largest, others = smallest_three(rows["quaternions"])
    scales, scale_labels = codebook(rows["log_scales"])
    colours, colour_labels = codebook(rows["sh_constant"])
    opacity = to_bytes(255 * opacities(gaussians)[order])
    meta: dict[str, Any] = {
        "version": 2, "asset": {"generator": GENERATOR}, "count": gaussians.count,
        "antialias": notes.antialiased,
        MEANS: {"mins": low.tolist(), "maxs": high.tolist()},
        SCALES: {"codebook": _single(scales)}, QUATERNIONS: {},
        COLOURS: {"codebook": _single(colours)}}
    textures = {
        MEANS: {"means_l.webp": _texture(steps & 255), "means_u.webp": _texture(steps >> 8)},
        SCALES: {"scales.webp": _texture(scale_labels)},
        QUATERNIONS: {"quats.webp": _texture(np.column_stack(
            [to_bytes((others / np.sqrt(2) + 0.5) * 255), FIRST_TAG + largest]))},
        COLOURS: {"sh0.webp": _texture(np.column_stack([colour_labels, opacity]))}}
    if origin.any():
        meta[ORIGIN] = origin.tolist()
    if rows["sh_rest"].any():
        meta[HARMONICS], textures[HARMONICS] = _harmonics(rows["sh_rest"], gaussians.sh_degree)
    for part, files in textures.items():
        meta[part]["files"] = list(files)
    with replacing(path) as file, zipfile.ZipFile(file, "w") as archive:
        archive.writestr(zipfile.ZipInfo(META, DATE), json.dumps(meta))
        for files in textures.values():
            for name, pixels in files.items():
                archive.writestr(zipfile.ZipInfo(name, DATE), encode_webp(pixels))


def is_unbundled(path: Path) -> bool:
    """Whether a path is that of a folder with textures, or of its meta.json."""
    return path.name.lower() == META or (path / META).is_file()


def read_sog(path: Path, offset: NDArray[np.float64] | None = None) -> Gaussians:
    """Read the gaussians of a SOG file, or of a folder; see `models.read_model`."""
    with reading(path, KIND), _opened(path) as part:
        meta = _meta(path, part)
        size, count = 0, meta["count"]
        textures: dict[str, list[NDArray[np.uint8]]] = {}
        for name, number in TEXTURES.items():
            contents = [part(file) for file in _files(meta, name, number)]
            size += sum(map(len, contents))
            textures[name] = [decode_webp(content) for content in contents]
        check_rows(size, _count(count), BANDS[meta.get(HARMONICS, {}).get("bands", 0)])
        low, high = (np.array(meta[MEANS][end], np.float64) for end in ("mins", "maxs"))
        lower, upper, quaternions, colours, scales = (
            _bytes(texture, count) for name in TEXTURES for texture in textures[name])
        steps = lower[:, :3] + 256.0 * upper[:, :3]
        tag = quaternions[:, 3].astype(int) - FIRST_TAG
        if count and not 0 <= tag.min() <= tag.max() < 4:
            raise ValueError("a quaternion has no largest component")
        rows = {
            "positions": _from_logarithm(low + (high - low) * (steps / 65535)),
            "sh_constant": _codes(meta[COLOURS])[colours[:, :3]],
            "sh_rest": _read_harmonics(meta, part, count),
            "opacity_logits": byte_logits(colours[:, 3]),
            "log_scales": _codes(meta[SCALES])[scales[:, :3]],
            "quaternions": from_smallest_three(
                tag, (quaternions[:, :3] / 255 - 0.5) * np.sqrt(2)),
        }
        origin = np.array(meta.get(ORIGIN, (0, 0, 0)), np.float64)
        if origin.shape != (3,):
            raise ValueError(f"its origin is {origin.tolist()}")
        return gaussians_of(path, rows, origin, offset)


def sog_notes(path: Path) -> Notes:
    """What a SOG file holds besides its gaussians; see `models.read_notes`."""
    with reading(path, KIND), _opened(path) as part:
        return Notes((MIP,) if _meta(path, part).get("antialias") else ())


@contextmanager
def _opened(path: Path) -> Iterator[Callable[[str], bytes]]:
    """A function that reads a part by its name: a member of the zip, which may all be in one of its
    folders, or a file beside meta.json."""
    if is_unbundled(path):
        folder = path / META if path.is_dir() else path
        yield lambda name: read_regular(folder.with_name(_plain(name)))
        return
    with opened_archive(path) as archive:
        if len(archive.members) > MOST_MEMBERS:
            raise ValueError(f"it has {len(archive.members)} members")
        archive.check(archive.members)
        found = min((name for name in archive.members if PurePosixPath(name).name == META),
                    key=len, default=META)
        yield lambda name: archive.read(found.removesuffix(META) + name)


def _plain(name: object) -> str:
    """The name of a file, which has no folder."""
    if not isinstance(name, str) or "\0" in name or name in ("", "..") or (
            PurePosixPath(name).name != name):
        raise ValueError(f"{str(name)[:40]!r} is not the name of a texture")
    return name


def _meta(path: Path, part: Callable[[str], bytes]) -> dict[str, Any]:
    meta = object_of(part(META))
    version = meta.get("version", 1)
    if version != 2:
        raise InputError(f"{path}: SOG of version {str(version)[:20]}, which is not read; write "
                         "version 2, as splat-transform does, or a PLY")
    return meta


def _files(meta: dict[str, Any], name: str, number: int) -> list[str]:
    """The names of the textures of a part."""
    files = meta[name]["files"]
    if not isinstance(files, list) or len(files) != number:
        raise ValueError(f"{name} has not {number} textures")
    return files


def _count(count: object) -> int:
    if type(count) is not int or count < 0:
        raise ValueError("count is not a number of gaussians")
    return count


def _harmonics(sh_rest: NDArray[np.float64], degree: int
               ) -> tuple[dict[str, Any], dict[str, NDArray[np.uint8]]]:
    """The entry of the meta data for harmonics [N, bands, 3], and their textures."""
    count, bands = sh_rest.shape[:2]
    most = min(MOST_COLOURS, max(FEWEST_COLOURS, count // GAUSSIANS_A_COLOUR))
    chosen, labels = palette(sh_rest.reshape(count, -1), most)
    codes, numbers = codebook(chosen)
    lines = -(-len(chosen) // PALETTE_COLUMNS)
    pixels = np.zeros((lines * PALETTE_COLUMNS, bands, 4), np.uint8)
    pixels[..., 3] = 255
    pixels[:len(chosen), :, :3] = numbers.reshape(-1, bands, 3)
    meta = {"count": len(chosen), "bands": degree, "codebook": _single(codes)}
    return meta, {"shN_centroids.webp": pixels.reshape(lines, PALETTE_COLUMNS * bands, 4),
                  "shN_labels.webp": _texture(np.stack([labels & 255, labels >> 8, 0 * labels], 1))}


def _read_harmonics(meta: dict[str, Any], read: Callable[[str], bytes], count: int
                    ) -> NDArray[np.float64]:
    """The harmonics float64[count, bands, 3] above the constant."""
    if HARMONICS not in meta:
        return np.zeros((count, 0, 3))
    part = meta[HARMONICS]
    bands = BANDS[part["bands"]]
    pixels, labels = (decode_webp(read(file)) for file in _files(meta, HARMONICS, 2))
    if pixels.shape[1] != PALETTE_COLUMNS * bands:
        raise ValueError(f"its palette is {pixels.shape[1]} pixels wide")
    chosen = pixels[..., :3].reshape(-1, bands, 3)
    numbers = _bytes(labels, count)
    label = numbers[:, 0] + 256 * numbers[:, 1].astype(int)
    if label.max(initial=-1) >= len(chosen):
        raise ValueError(f"its palette has only {len(chosen)} entries")
    harmonics: NDArray[np.float64] = _codes(part)[chosen[label]]
    return harmonics


def _texture(values: NDArray[Any]) -> NDArray[np.uint8]:
    """Pixels [H, W, 4] of bytes [N, 3 or 4]; without a fourth column, that channel is 255."""
    width = max(4, int(np.ceil(np.sqrt(len(values)) / 4)) * 4)
    height = max(4, -(-len(values) // width // 4) * 4)
    pixels = np.zeros((height * width, 4), np.uint8)
    pixels[:, 3] = 255
    pixels[:len(values), :values.shape[1]] = values
    return pixels.reshape(height, width, 4)


def _bytes(texture: NDArray[np.uint8], count: int) -> NDArray[np.uint8]:
    """The first `count` pixels of a texture, uint8[count, 4]."""
    pixels = texture.reshape(-1, 4)
    if count > len(pixels):
        raise ValueError(f"a texture has {len(pixels)} pixels for {count} gaussians")
    return pixels[:count]


def _codes(part: dict[str, Any]) -> NDArray[np.float64]:
    """A codebook float64[256]; numbers that a file leaves out are zero."""
    codes = np.array(part["codebook"], np.float64)
    if codes.ndim != 1 or len(codes) > 256:
        raise ValueError(f"a codebook has the shape {codes.shape}")
    return np.pad(codes, (0, 256 - len(codes)))


def _single(values: NDArray[np.float64]) -> list[float]:
    """The shortest decimal numbers that single precision distinguishes."""
    return [float(str(value)) for value in values.astype(np.float32)]


def _to_logarithm(values: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.sign(values) * np.log1p(np.abs(values))


def _from_logarithm(values: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.sign(values) * np.expm1(np.minimum(np.abs(values), 88))


def encode_webp(pixels: NDArray[np.uint8]) -> bytes:
    """The bytes of a WebP file of pixels uint8[H, W, 4].

    They come back as they are, except that the colours of a pixel with a last channel of 0 may
    become 0.
    """
    return encode_image(pixels, "webp", 100, "WebP", {
        "compression": "lossless:50", "webp:method": 3, "oiio:UnassociatedAlpha": 1})


def decode_webp(data: bytes) -> NDArray[np.uint8]:
    """The pixels uint8[H, W, 4] of a WebP file; ValueError if it is damaged or too large."""
    import OpenImageIO as oiio

    config = oiio.ImageSpec()
    config.attribute("oiio:UnassociatedAlpha", 1)  # as stored, not multiplied by the last channel
    with temporary_file(data) as path:
        image = oiio.ImageInput.open(path, config)
        reason = reason_of(oiio)
        if image is None or image.format_name() != "webp":
            raise ValueError(f"a texture is no WebP {reason}")
        try:
            spec = image.spec()
            check_expansion(len(data), spec.width * spec.height * 4)
            pixels = image.read_image("uint8")
            reason = reason_of(image)
        finally:
            image.close()
    if pixels is None or reason:
        raise ValueError(f"a texture is damaged: {reason}")
    if pixels.shape[2] == 3:  # an encoder may leave out a last channel of 255
        pixels = np.concatenate([pixels, np.full((*pixels.shape[:2], 1), 255, np.uint8)], axis=2)
    return pixels
