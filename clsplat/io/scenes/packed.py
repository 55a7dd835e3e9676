"""A whole scene in one .npz, for machines that do not have its folder.

Keys: names[V]; V float64[V, 4, 4] world to camera; K float64[V, 3, 3] and wh int[V, 2], pixels;
xyz float64[N, 3] and rgb uint8[N, 3]; offset float64[3], which was subtracted from the original
world coordinates; sizes int[V], the bytes of each encoded photo, and jpeg uint8[...], all photos
one after the other. These may be missing: observations int[M, 2], rows (point, view); held_out
bool[V], the test views; up float64[3], the direction that points up; georeference uint8[...], the
JSON of georeference.json; mask_sizes int[V] and masks uint8[...], masks like photos (0 bytes: none)
"""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.camera import Camera
from clsplat.errors import InputError
from clsplat.io.atomic import replacing
from clsplat.io.georeference.files import georeference_of, georeference_record
from clsplat.io.npz import read_npz
from clsplat.io.photos.images import encode_image, encode_jpeg, read_image
from clsplat.io.photos.views import read_photo, read_valid
from clsplat.io.records import object_of
from clsplat.io.scenes.checks import checked_scene
from clsplat.io.scenes.sources import checked_photos
from clsplat.scene import Scene

PACKED_QUALITY = 96  # of JPEG
# key -> (kinds of dtype, shape after the first axis)
LAYOUT = {"names": ("U", ()), "V": ("f", (4, 4)), "K": ("f", (3, 3)), "wh": ("iu", (2,)),
          "xyz": ("f", (3,)), "rgb": ("u", (3,)), "sizes": ("iu", ()), "jpeg": ("u", ())}
OPTIONAL = {"offset": ("f", ()), "observations": ("iu", (2,)), "held_out": ("b", ()),
            "up": ("f", ()), "georeference": ("u", ()), "mask_sizes": ("iu", ()),
            "masks": ("u", ())}


def write_packed(scene: Scene, path: str | Path, downscale: float = 1) -> None:
    """Write a scene to one .npz; all photos are read, and so checked.

    Parameters
    ----------
    downscale : 1 keeps the bytes of the photos; others divide width and height, round them down,
        resample by area averaging and encode as JPEG of quality 96.
    """
    cameras, photos, masks = [], [], []
    for view in scene.views:
        camera, source = view.camera, view.source
        if downscale == 1 and not (view.lens or view.levels):
            read_image(source)
            photo = source if isinstance(source, bytes) else source.read_bytes()
        else:
            camera = camera.reduced(downscale)
            view = replace(view, camera=camera)
            photo = encode_jpeg(read_photo(view), PACKED_QUALITY)
        cameras.append(camera)
        photos.append(photo)
        masks.append(_encoded(read_valid(view)))
    optional: dict[str, Any] = {}
    if any(masks):
        optional["mask_sizes"] = np.array([len(mask) for mask in masks])
        optional["masks"] = np.frombuffer(b"".join(masks), np.uint8)
    if scene.observations is not None:
        optional["observations"] = scene.observations
    if scene.held_out is not None:
        optional["held_out"] = np.array([view.name in scene.held_out for view in scene.views])
    if scene.given_up is not None:
        optional["up"] = scene.given_up
    if scene.georeference is not None:
        text = json.dumps(georeference_record(scene.georeference)).encode()
        optional["georeference"] = np.frombuffer(text, np.uint8)
    with replacing(path) as file:
        np.savez(
            file, names=np.array([view.name for view in scene.views]),
            V=np.array([_view_matrix(c) for c in cameras]),
            K=np.array([_calibration(c) for c in cameras]),
            wh=np.array([(c.width, c.height) for c in cameras]),
            xyz=scene.points, rgb=scene.colours, offset=scene.offset,
            sizes=np.array([len(photo) for photo in photos]),
            jpeg=np.frombuffer(b"".join(photos), np.uint8), **optional)


def read_packed(path: str | Path) -> Scene:
    """Read the scene of a packed .npz; the source of each view is its encoded photo.

    The scene of a file without `offset` is recentred, as that of a COLMAP folder is.
    """
    path = Path(path)
    arrays = _read_arrays(path)
    photos = _parts(arrays["jpeg"], arrays["sizes"])
    poses, calibrations = arrays["V"], arrays["K"]
    scene = checked_photos(checked_scene(path, path.stem, {
        "names": arrays["names"],
        "rotations": poses[:, :3, :3], "translations": poses[:, :3, 3],
        "focals": calibrations[:, (0, 1), (0, 1)], "centres": calibrations[:, :2, 2],
        "sizes": arrays["wh"], "points": arrays["xyz"], "colours": arrays["rgb"],
        "observations": arrays.get("observations", np.zeros((0, 2), int)),
    }, photos, arrays.get("offset")))
    if "masks" in arrays:
        masks = dict(zip(map(str, arrays["names"]), _parts(arrays["masks"], arrays["mask_sizes"])))
        scene = replace(scene, views=tuple(
            replace(view, mask=masks[view.name] or None) for view in scene.views))
    if "held_out" in arrays:
        held_out = frozenset(map(str, arrays["names"][arrays["held_out"]]))
        scene = replace(scene, held_out=held_out or None)
    scene = _placed(path, scene, arrays)
    return scene if "offset" in arrays else scene.recentred()


def _placed(path: Path, scene: Scene, arrays: dict[str, NDArray[Any]]) -> Scene:
    if "up" in arrays:
        scene = scene.with_up(arrays["up"])
    if "georeference" in arrays:
        try:
            georeference = georeference_of(object_of(arrays["georeference"].tobytes()))
        except ValueError as error:
            raise InputError(f"{path}: the georeference of the packed scene is damaged ({error}); "
                             "pack it again") from None
        scene = replace(scene, georeference=georeference)
    return scene


def _parts(joined: NDArray[np.uint8], sizes: NDArray[np.integer]) -> list[bytes]:
    """The images of these sizes in bytes, which lie one after the other."""
    return [joined[end - size:end].tobytes() for end, size in zip(np.cumsum(sizes), sizes)]


def _encoded(valid: NDArray[np.bool_] | None) -> bytes:
    """A mask as PNG, or nothing."""
    if valid is None:
        return b""
    pixels = np.repeat(valid[:, :, None], 3, axis=2) * np.uint8(255)
    return encode_image(pixels, "png", 0, "mask")


def _view_matrix(camera: Camera) -> NDArray[np.float64]:
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = camera.rotation, camera.translation
    return matrix


def _calibration(camera: Camera) -> NDArray[np.float64]:
    (fx, fy), (cx, cy) = camera.focal, camera.centre
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])


def _read_arrays(path: Path) -> dict[str, NDArray[Any]]:
    arrays = read_npz(path, "not a packed scene, or damaged", "pack or copy it again",
                      lambda name: name in LAYOUT or name in OPTIONAL)
    for key, (kinds, shape) in {**LAYOUT, **OPTIONAL}.items():
        array = arrays.get(key)
        if array is None and key in OPTIONAL:
            continue
        if array is None or array.dtype.kind not in kinds or array.shape[1:] != shape:
            cause = "is missing" if array is None else f"is {array.dtype}{list(array.shape)}"
            raise InputError(f"{path}: not a packed scene: array '{key}' {cause}; pack it again")
    _check_lengths(path, arrays)
    return arrays


def _check_lengths(path: Path, arrays: dict[str, NDArray[Any]]) -> None:
    views = {key: len(arrays[key]) for key in ("names", "V", "K", "wh", "sizes")}
    sizes, offset = arrays["sizes"], arrays.get("offset", np.zeros(3))
    up = arrays.get("up", np.ones(3))
    whole = (len(set(views.values())) == 1 and len(arrays["xyz"]) == len(arrays["rgb"])
             and (sizes >= 0).all() and int(sizes.sum()) == len(arrays["jpeg"])
             and arrays["rgb"].dtype == arrays["jpeg"].dtype == np.uint8
             and len(arrays.get("held_out", sizes)) == len(sizes) and _masks_fit(arrays)
             and offset.shape == (3,) and offset.dtype.kind == "f" and np.isfinite(offset).all()
             and up.shape == (3,) and 0 < float(np.linalg.norm(up)) < np.inf)
    if not whole:
        raise InputError(f"{path}: the arrays of the packed scene do not fit each other; "
                         "pack it again")


def _masks_fit(arrays: dict[str, NDArray[Any]]) -> bool:
    """Whether the masks of a packed scene are whole, or it has none."""
    sizes, masks = arrays.get("mask_sizes"), arrays.get("masks")
    if sizes is None or masks is None:
        return sizes is masks
    return bool(len(sizes) == len(arrays["sizes"]) and (sizes >= 0).all()
                and int(sizes.sum()) == len(masks) and masks.dtype == np.uint8)
