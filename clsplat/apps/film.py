"""Films: frames of a model along a camera's path, as H.264 or as PNG files."""

import re
from collections.abc import Callable, Iterable
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.apps.models import in_original, supported
from clsplat.camera import Camera
from clsplat.device import Device
from clsplat.edit.select import selected
from clsplat.errors import InputError
from clsplat.evaluation.run import Run, open_shown
from clsplat.gaussians import Gaussians
from clsplat.io.atomic import replacing
from clsplat.io.folders import make_folder
from clsplat.io.photos.images import eight_bits, write_image
from clsplat.rendering.tree import HOST_BYTES
from clsplat.scene import Scene

try:
    import av
except ImportError:
    av = None  # type: ignore[assignment]

FRAME = re.compile(r"frame_\d{5,}\.png")
SUFFIXES = (".mp4", ".mov", ".mkv")
QUALITY = "18"  # constant rate factor of H.264: hardly different from the frames
LIMITED_RANGE = BT709 = 1  # numbers of ITU-T H.273, by which players find the colours
Pixels = NDArray[np.uint8]  # [H, W, 3]


def check_codec() -> None:
    """InputError if av, which encodes films, is not installed."""
    if av is None:
        raise InputError("films need av, which is not installed: pip install av; or give a folder for PNG files")


def frames(
    run: Run,
    scene: Scene,
    cameras: Iterable[Camera],
    device: Device,
    host_bytes: float = HOST_BYTES,
    everything: bool = False,
) -> Iterable[Pixels]:
    """Draw a finished run.

    Parameters
    ----------
    run, scene, device : finished, its scene, and an open device.
    cameras : in original coordinates.
    host_bytes : for a tree; see `TreeRenderer`.
    everything : whether gaussians that are not `supported` are drawn, as a tree's always are.
    """

    def supported_model() -> Gaussians:
        model = run.finished_model
        return model if everything else selected(model, supported(model, in_original(scene)))

    near = scene.near(run.options.near) * scene.unit
    renderer, rows, model = open_shown(run, device, near, host_bytes, supported_model)
    for camera in cameras:
        packed = renderer.pack(camera.shifted(model.offset))
        frame = renderer.render(rows, packed, camera.width, camera.height, model.sh_degree)
        yield eight_bits(frame.image.download().transpose(1, 2, 0))


def write_film(
    path: Path,
    pictures: Iterable[Pixels],
    size: tuple[int, int],
    rate: Fraction,
    shown: Callable[[int], object] = lambda _: None,
) -> None:
    """Replace a film: H.264 with 4:2:0 colours, which every player shows.

    Parameters
    ----------
    path : the file; its suffix, one of SUFFIXES, selects the container.
    pictures : the frames.
    size : (width, height), pixels, even numbers.
    rate : frames a second.
    shown : called with the number of frames so far.

    Raises
    ------
    clsplat.ClsplatError : the disk is full.
    """
    kind = {".mkv": "matroska"}.get(path.suffix.lower(), path.suffix.lower()[1:])
    # the index first, so that a page can play the film while it loads
    options = {} if kind == "matroska" else {"movflags": "faststart"}
    with replacing(path) as file, av.open(file.name, mode="w", format=kind, options=options) as container:
        stream: Any = container.add_stream("libx264", rate=rate)
        stream.width, stream.height, stream.pix_fmt = *size, "yuv420p"
        stream.options = {"crf": QUALITY}
        coder = stream.codec_context
        coder.color_range, coder.colorspace = LIMITED_RANGE, BT709
        coder.color_primaries = coder.color_trc = BT709
        for number, picture in enumerate(pictures, 1):
            frame = av.VideoFrame.from_ndarray(picture, format="rgb24")
            container.mux(stream.encode(frame.reformat(format="yuv420p", dst_colorspace="ITU709")))
            shown(number)
        container.mux(stream.encode())


def write_frames(folder: Path, pictures: Iterable[Pixels], shown: Callable[[int], object] = lambda _: None) -> None:
    """Write FOLDER/frame_00001.png and so on, in place of `frames_in` the folder, which is created
    if it is missing; other arguments as for `write_film`."""
    make_folder(folder)
    for path in frames_in(folder):
        path.unlink()
    for number, picture in enumerate(pictures, 1):
        write_image(folder / f"frame_{number:05d}.png", picture)
        shown(number)


def frames_in(folder: Path) -> list[Path]:
    """The files of a folder that have names of `write_frames`."""
    return [path for path in folder.glob("frame_*.png") if FRAME.fullmatch(path.name)]
