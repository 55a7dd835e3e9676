"""Films: frames of a model along a camera's path, as H.264 or as PNG files."""

from __future__ import annotations

import re
import tempfile
from collections.abc import Callable, Iterable, Iterator
from fractions import Fraction
from io import BufferedWriter
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clsplat.apps.models import in_original, supported
from clsplat.camera import Camera
from clsplat.device import Device
from clsplat.edit.select import selected
from clsplat.errors import InputError
from clsplat.evaluation.run import Run, Streaming, open_tree
from clsplat.gaussians import Gaussians
from clsplat.io.atomic import replacing
from clsplat.io.folders import make_folder
from clsplat.io.models.tree import Tree
from clsplat.io.photos.images import eight_bits, write_image
from clsplat.rendering.slabs import ModelRenderer, open_model
from clsplat.scene import Scene

try:
    import av
    import av.filter
except ImportError:
    av = None  # type: ignore[assignment]

FRAME = re.compile(r"frame_\d{5,}\.png")
GIF = ".gif"
SUFFIXES = (".mp4", ".mov", ".mkv", GIF)
# a palette of each frame, as one of all would need all of them in memory; 64 colours in a pattern
# that does not flicker have half the bytes of 256
PALETTE = (("split", ""), ("palettegen", "stats_mode=single:max_colors=64"),
           ("paletteuse", "new=1:dither=bayer:bayer_scale=5"))
QUALITY = "18"  # constant rate factor of H.264: hardly different from the frames
LIMITED_RANGE = BT709 = 1  # numbers of ITU-T H.273, by which players find the colours
Pixels = NDArray[np.uint8]  # [H, W, 3]


def check_codec() -> None:
    """InputError if av, which encodes films, is not installed."""
    if av is None:
        raise InputError("films need av, which is not installed: pip install av; or give a folder "
                         "for PNG files")


def frames(run: Run, scene: Scene, cameras: Iterable[Camera], device: Device,
           streaming: Streaming | None = None, everything: bool = False) -> Iterable[Pixels]:
    """Draw a finished run.

    Parameters
    ----------
    run : the run.
    scene : of the run; from which the near plane follows.
    cameras : in original coordinates.
    device : an open device.
    streaming : draw the tree of the run in this way, which always draws all; None: its model.
    everything : whether gaussians that are not `supported` are drawn.
    """
    options = run.options
    near = scene.near(options.near) * scene.unit
    renderer: ModelRenderer
    rows: Any
    model: Tree | Gaussians
    if streaming:
        renderer, rows = open_tree(run, device, near, streaming)
        model = rows
    else:
        model = run.finished_model
        if not everything:
            model = selected(model, supported(model, in_original(scene)))
        renderer, rows = open_model(device, model, near, options.antialiased, options.background)
    for camera in cameras:
        packed = renderer.pack(camera.shifted(model.offset))
        frame = renderer.render(rows, packed, camera.width, camera.height, model.sh_degree)
        yield eight_bits(frame.image.download().transpose(1, 2, 0))


class _Sink:
    """A file that av writes to. It drops exceptions of its files, so the first is kept, and raised
    between two frames.

    Parameters
    ----------
    file : open for writing; av finds it by its name too.
    """

    def __init__(self, file: BufferedWriter) -> None:
        self.file, self.name = file, file.name
        self.error: OSError | None = None
        self.seek, self.tell = file.seek, file.tell

    def write(self, content: bytes) -> int:
        """Write to the disk, unless that has failed before."""
        if self.error is None:
            try:
                self.put(content)
            except OSError as error:
                self.error = error
        return len(content)

    def put(self, content: bytes) -> None:
        """Write, and see at once whether the disk is full."""
        self.file.write(content)
        self.file.flush()

    def check(self) -> None:
        """Raise the OSError of a write."""
        if self.error is not None:
            raise self.error


def write_film(path: Path, pictures: Iterable[Pixels], size: tuple[int, int], rate: Fraction,
               shown: Callable[[int], object] = lambda _: None) -> None:
    """Replace a film: H.264 with 4:2:0 colours, which every player shows, or a GIF without end.

    Parameters
    ----------
    path : the file; its suffix, one of SUFFIXES, selects the container.
    pictures : the frames.
    size : (width, height), pixels; of H.264 even numbers.
    rate : frames a second.
    shown : called with the number of frames so far.

    Raises
    ------
    clsplat.ClsplatError : av is not installed, or the disk is full.
    """
    check_codec()
    kind = {".mkv": "matroska"}.get(path.suffix.lower(), path.suffix.lower()[1:])
    coder = _gif if kind == GIF[1:] else _h264
    with replacing(path) as file:
        sink = _Sink(file)
        # the index first, so that a page can play the film while it loads
        options = {"movflags": "faststart"} if kind in ("mp4", "mov") else {}
        with av.open(sink, mode="w", format=kind, options=options) as container:
            for number, packets in enumerate(coder(container, pictures, size, rate), 1):
                container.mux(packets)
                sink.check()
                shown(number)
        sink.check()


def _h264(container: Any, pictures: Iterable[Pixels], size: tuple[int, int], rate: Fraction
          ) -> Iterator[Any]:
    """The packets of each frame; those that come late are muxed at once."""
    stream = container.add_stream("libx264", rate=rate)
    stream.width, stream.height, stream.pix_fmt = *size, "yuv420p"
    stream.options = {"crf": QUALITY}
    coder = stream.codec_context
    coder.color_range, coder.colorspace = LIMITED_RANGE, BT709
    coder.color_primaries = coder.color_trc = BT709
    for picture in pictures:
        yield stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24").reformat(
            format="yuv420p", dst_colorspace="ITU709"))
    container.mux(stream.encode())


def _gif(container: Any, pictures: Iterable[Pixels], size: tuple[int, int], rate: Fraction
         ) -> Iterator[Any]:
    """The packets of each frame."""
    stream = container.add_stream("gif", rate=rate)
    stream.width, stream.height, stream.pix_fmt = *size, "pal8"
    graph = av.filter.Graph()
    source = graph.add_buffer(width=size[0], height=size[1],
                              format=av.VideoFormat("rgb24"), time_base=1 / rate)
    split, palette, use = (graph.add(*each) for each in PALETTE)
    sink = graph.add("buffersink")
    source.link_to(split)
    split.link_to(use, 0, 0)
    split.link_to(palette, 1, 0)
    palette.link_to(use, 0, 1)
    use.link_to(sink)
    graph.configure()
    for number, picture in enumerate(pictures):
        frame = av.VideoFrame.from_ndarray(picture, format="rgb24")
        frame.pts, frame.time_base = number, 1 / rate
        source.push(frame)
        yield stream.encode(sink.pull())
    container.mux(stream.encode())


def write_frames(folder: Path, pictures: Iterable[Pixels],
                 shown: Callable[[int], object] = lambda _: None) -> None:
    """Write FOLDER/frame_00001.png and so on, in place of `frames_in` the folder.

    They appear when all are drawn.

    Parameters
    ----------
    folder : is created if it is missing.
    pictures, shown : as for `write_film`.
    """
    make_folder(folder)
    with tempfile.TemporaryDirectory(prefix=".frames-", dir=folder) as beside:
        for number, picture in enumerate(pictures, 1):
            write_image(Path(beside) / f"frame_{number:05d}.png", picture)
            shown(number)
        drawn = {path.name: path for path in Path(beside).iterdir()}
        for name in sorted(drawn):
            drawn[name].replace(folder / name)
        for path in frames_in(folder):
            if path.name not in drawn:
                path.unlink()


def frames_in(folder: Path) -> list[Path]:
    """The files of a folder that have names of `write_frames`."""
    return [path for path in folder.glob("frame_*.png") if FRAME.fullmatch(path.name)]
