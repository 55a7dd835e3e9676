"""Gaussians as SOG, the format of PlayCanvas: lossless WebP textures in a zip, version 2.

Each gaussian is a pixel of every texture. Positions have 16 bits a coordinate, on a scale that is
logarithmic far from the origin; log scales, colours and harmonics are numbers of a codebook of 256;
the harmonics of all gaussians are chosen from a palette.
"""

import json
import warnings
import zipfile
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path, PurePosixPath
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from clsplat.errors import InputError
from clsplat.gaussians import Gaussians
from clsplat.io.atomic import replacing
from clsplat.io.fields import reading
from clsplat.io.models import values as stored
from clsplat.io.models.values import Notes, from_smallest_three
from clsplat.io.photos.images import encode_image
from clsplat.io.photos.photo import opened
from clsplat.io.records import object_of
from clsplat.io.regular import check_expansion, check_rows, opened_archive, read_regular

META, ORIGIN, KIND = "meta.json", "clsplat_origin", "a SOG file of version 2"
MEANS, SCALES, QUATERNIONS, COLOURS, HARMONICS = "means", "scales", "quats", "sh0", "shN"
# the textures of each part; harmonics may be missing
TEXTURES = {
    MEANS: ["means_l.webp", "means_u.webp"],
    SCALES: ["scales.webp"],
    QUATERNIONS: ["quats.webp"],
    COLOURS: ["sh0.webp"],
    HARMONICS: ["shN_centroids.webp", "shN_labels.webp"],
}
BANDS = {0: 0, 1: 3, 2: 8, 3: 15}  # harmonics above the constant, by their degree
DATE = (1980, 1, 1, 0, 0, 0)  # of every member, so that equal models give equal bytes
COMPONENT_STEPS = stored.Steps(255 / 2**0.5, 127.5)  # of a quaternion
FIRST_TAG = 252  # of the last channel of quaternions: tag + which component is the largest
LARGEST_STEP = 65535  # of a position
PALETTE_COLUMNS = 64
# colours of the palette: one a gaussian for small models, one for many gaussians of large ones
FEWEST_COLOURS, MOST_COLOURS, GAUSSIANS_A_COLOUR = 1024, 1 << 13, 32
SMALLEST_SPAN = 1e-12
CODEBOOK, CODEBOOK_ROUNDS = 256, 30
# of a palette; said once, as a context would hold for all threads and end in the midst of others
warnings.filterwarnings("ignore", "One of the clusters is empty", UserWarning)
PALETTE_ROUNDS, MOST_SAMPLED = 3, 1 << 18


def write_sog(path: Path, gaussians: Gaussians, notes: Notes) -> None:
    """Write gaussians as SOG; see `models.write_model`.

    They are sorted along a curve in space. Of the comments, only whether the model is antialiased
    has a place.
    """
    with replacing(path) as file, zipfile.ZipFile(file, "w") as archive:
        for name, content in sog_files(gaussians, notes, along_curve=True):
            archive.writestr(zipfile.ZipInfo(name, DATE), content)


def sog_files(gaussians: Gaussians, notes: Notes, along_curve: bool) -> Iterator[tuple[str, bytes]]:
    """The name and the content of each file of a SOG, which a zip or a folder has; the gaussians
    are sorted along a curve in space, or stay in order."""
    rows, origin = stored.stored_rows(gaussians, along_curve)
    logarithms = np.sign(rows["positions"]) * np.log1p(np.abs(rows["positions"]))
    low, high = (logarithms.min(axis=0), logarithms.max(axis=0)) if gaussians.count else np.zeros((2, 3))
    steps = np.rint((logarithms - low) / np.maximum(high - low, SMALLEST_SPAN) * LARGEST_STEP).astype(int)
    largest, others = stored.smallest_three(rows["quaternions"])
    scales, scale_labels = _codebook(rows["log_scales"])
    colours, colour_labels = _codebook(rows["sh_constant"])
    opacity = stored.OPACITY_STEPS.bytes(scipy.special.expit(rows["opacity_logits"]))
    # the record and the textures of each
    parts: dict[str, tuple[dict[str, Any], list[NDArray[np.uint8]]]] = {
        MEANS: ({"mins": low.tolist(), "maxs": high.tolist()}, [_texture(steps & 255), _texture(steps >> 8)]),
        SCALES: ({"codebook": scales}, [_texture(scale_labels)]),
        QUATERNIONS: ({}, [_texture(np.column_stack([COMPONENT_STEPS.bytes(others), FIRST_TAG + largest]))]),
        COLOURS: ({"codebook": colours}, [_texture(np.column_stack([colour_labels, opacity]))]),
    }
    if rows["sh_rest"].any():
        parts[HARMONICS] = _harmonics(rows["sh_rest"], gaussians.sh_degree)
    meta = {
        "version": 2,
        "asset": {"generator": "clsplat"},
        "count": gaussians.count,
        "antialias": notes.antialiased,
        **{part: {**record, "files": TEXTURES[part]} for part, (record, _) in parts.items()},
        **({ORIGIN: origin.tolist()} if origin.any() else {}),
    }
    yield META, json.dumps(meta).encode()
    for part, (_, textures) in parts.items():
        for name, texture in zip(TEXTURES[part], textures):
            yield name, encode_webp(texture)


def read_sog(path: Path, offset: NDArray[np.float64] | None = None) -> tuple[Gaussians, Notes]:
    """Read a SOG file, or a folder of its parts, named by itself or by its meta.json; see
    `models.read_with_notes`."""
    parts = path if path.is_dir() else path.parent if path.name == META else None
    source: AbstractContextManager[Any] = opened_archive(path) if parts is None else nullcontext((None, {}))
    with reading(path, KIND), source as (archive, members):
        # some programs zip their folder
        inside = {PurePosixPath(name).name: member for name, member in members.items()}

        def read(name: str) -> bytes:
            if archive is None:
                return read_regular(Path(parts or "", PurePosixPath(name).name))
            with archive.open(inside[name]) as stream:
                return bytes(stream.read(inside[name].file_size + 1))

        meta = object_of(read(META))
        if meta.get("version", 1) != 2:
            raise ValueError("another version is not read; splat-transform writes version 2")
        count = meta["count"]
        if type(count) is not int or count < 0:
            raise ValueError("count is not a number of gaussians")
        contents = [
            read(name)
            for part in (MEANS, SCALES, QUATERNIONS, COLOURS)
            for _, name in zip(TEXTURES[part], meta[part]["files"])
        ]
        degree = meta.get(HARMONICS, {}).get("bands", 0)
        check_rows(sum(map(len, contents)), count, BANDS[degree])
        lower, upper, scales, quaternions, colours = (_pixels(_decoded(content), count) for content in contents)
        low, high = (np.array(meta[MEANS][end], np.float64) for end in ("mins", "maxs"))
        logarithms = low + (high - low) * ((lower[:, :3] + 256.0 * upper[:, :3]) / LARGEST_STEP)
        tag = quaternions[:, 3].astype(int) - FIRST_TAG
        rows = {
            "positions": np.sign(logarithms) * np.expm1(np.minimum(np.abs(logarithms), 88)),
            "sh_constant": _codes(meta[COLOURS])[colours[:, :3]],
            "sh_rest": _read_harmonics(meta, read, count),
            "opacity_logits": stored.byte_logits(colours[:, 3]),
            "log_scales": _codes(meta[SCALES])[scales[:, :3]],
            "quaternions": from_smallest_three(tag, COMPONENT_STEPS.values(quaternions[:, :3])),
        }
        origin = np.array(meta.get(ORIGIN, (0, 0, 0)), np.float64).reshape(3)
        return (stored.gaussians_of(path, rows, origin, offset), Notes((stored.MIP,) if meta.get("antialias") else ()))


def _harmonics(sh_rest: NDArray[np.float64], degree: int) -> tuple[dict[str, Any], list[NDArray[np.uint8]]]:
    """The record of harmonics [N, bands, 3], and their textures."""
    count, bands = sh_rest.shape[:2]
    most = min(MOST_COLOURS, max(FEWEST_COLOURS, count // GAUSSIANS_A_COLOUR))
    chosen, labels = _palette(sh_rest.reshape(count, -1), most)
    codes, numbers = _codebook(chosen)
    lines = -(-len(chosen) // PALETTE_COLUMNS)
    pixels = np.zeros((lines * PALETTE_COLUMNS, bands, 4), np.uint8)
    pixels[..., 3] = 255
    pixels[: len(chosen), :, :3] = numbers.reshape(-1, bands, 3)
    return (
        {"count": len(chosen), "bands": degree, "codebook": codes},
        [
            pixels.reshape(lines, PALETTE_COLUMNS * bands, 4),
            _texture(np.stack([labels & 255, labels >> 8, 0 * labels], 1)),
        ],
    )


def _read_harmonics(meta: dict[str, Any], read: Callable[[str], bytes], count: int) -> NDArray[np.float64]:
    """The harmonics float64[count, bands, 3] above the constant."""
    if HARMONICS not in meta:
        return np.zeros((count, 0, 3))
    part = meta[HARMONICS]
    bands = BANDS[part["bands"]]
    pixels, labels = (_decoded(read(name)) for _, name in zip(TEXTURES[HARMONICS], part["files"]))
    if pixels.shape[1] != PALETTE_COLUMNS * bands:
        raise ValueError(f"its palette is {pixels.shape[1]} pixels wide")
    numbers = _pixels(labels, count)
    chosen = pixels[..., :3].reshape(-1, bands, 3)[numbers[:, 0] + 256 * numbers[:, 1].astype(int)]
    return np.asarray(_codes(part)[chosen], np.float64)


def _texture(values: NDArray[Any]) -> NDArray[np.uint8]:
    """Pixels [H, W, 4] of bytes [N, 3 or 4]; without a fourth column, that channel is 255."""
    width = max(4, int(np.ceil(np.sqrt(len(values)) / 4)) * 4)
    height = max(4, -(-len(values) // width // 4) * 4)
    pixels = np.zeros((height * width, 4), np.uint8)
    pixels[:, 3] = 255
    pixels[: len(values), : values.shape[1]] = values
    return pixels.reshape(height, width, 4)


def _pixels(texture: NDArray[np.uint8], count: int) -> NDArray[np.uint8]:
    """The first `count` pixels of a texture, uint8[count, 4]."""
    pixels = texture.reshape(-1, 4)
    if count > len(pixels):
        raise ValueError(f"a texture has {len(pixels)} pixels for {count} gaussians")
    return pixels[:count]


def _codes(part: dict[str, Any]) -> NDArray[np.float64]:
    """A codebook float64[256]; numbers that a file leaves out are zero."""
    codes = np.array(part["codebook"], np.float64)
    return np.pad(codes, (0, 256 - len(codes)))


def _codebook(values: NDArray[np.floating]) -> tuple[list[float], NDArray[np.uint8]]:
    """256 numbers, ascending, that stand for all values with little squared error (Lloyd's
    algorithm), and uint8[...], which of them stands for each value."""
    ordered = np.sort(values.ravel().astype(np.float64))
    if not len(ordered):
        return CODEBOOK * [0.0], np.zeros(values.shape, np.uint8)
    sums = np.concatenate([[0], np.cumsum(ordered)])
    # half of the first numbers follow how many values there are, half how far they reach
    ranks = np.linspace(0, len(ordered) - 1, CODEBOOK // 2).astype(int)
    centres = np.sort(np.concatenate([ordered[ranks], np.linspace(ordered[0], ordered[-1], CODEBOOK // 2)]))
    for _ in range(CODEBOOK_ROUNDS):
        cuts = np.searchsorted(ordered, (centres[1:] + centres[:-1]) / 2)
        cuts = np.concatenate([[0], cuts, [len(ordered)]])
        count = np.diff(cuts)
        centres = np.where(count > 0, np.diff(sums[cuts]) / np.maximum(count, 1), centres)
        centres = np.maximum.accumulate(centres)  # rounding of the sums may swap neighbours
    labels = np.searchsorted((centres[1:] + centres[:-1]) / 2, values)
    return centres.astype(np.float32).tolist(), labels.astype(np.uint8)


def _palette(rows: NDArray[np.floating], most: int) -> tuple[NDArray[np.float32], NDArray[np.intp]]:
    """float32[K, D], at most `most` rows that stand for all rows [N, D] with little squared error
    (Lloyd's algorithm from evenly spaced rows), and int[N], which of them stands for each row.

    Of many rows, some are enough to find these. On 376,339 gaussians the error is 1 % above that of
    clusters which are cut in two until there are enough.
    """
    values = rows.astype(np.float32)
    sample = values[:: -(-len(values) // MOST_SAMPLED)]
    first = sample[np.linspace(0, len(sample) - 1, min(most, len(sample))).astype(int)]
    centres, _ = scipy.cluster.vq.kmeans2(sample, first, PALETTE_ROUNDS, minit="matrix")
    return centres, scipy.cluster.vq.vq(values, centres)[0]


def encode_webp(pixels: NDArray[np.uint8]) -> bytes:
    """The bytes of a WebP file of pixels uint8[H, W, 4].

    They come back as they are, except that the colours of a pixel with a last channel of 0 may
    become 0.
    """
    return encode_image(
        pixels, "webp", 100, "WebP", {"compression": "lossless:50", "webp:method": 3, "oiio:UnassociatedAlpha": 1}
    )


def _decoded(data: bytes) -> NDArray[np.uint8]:
    """The pixels uint8[H, W, 4] of a texture, as stored; ValueError if it is damaged or too large."""
    try:
        with opened(data) as image:
            check_expansion(len(data), image.width * image.height * 4)
            image.to_srgb = None  # they are numbers, not colours
            colours = np.concatenate(list(image.bands(0, image.height)))
            # an encoder may leave out a last channel of 255
            last = image.alpha() if image.has_alpha else np.full(colours.shape[:2], 255, np.uint8)
    except InputError as error:  # it does not name the file
        raise ValueError(f"a texture is damaged: {error}") from None
    return np.dstack([colours, last])
