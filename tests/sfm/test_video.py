"""Frames of a video: the sharpest of each window, upright."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from clsplat.errors import InputError
from clsplat.io.photos.images import read_image
from clsplat.sfm.video import check_video, extract_frames
from tests.sfm.cases import Lines, picture


def film(path, frames):
    """Write an MP4 of frames uint8[H, W, 3]."""
    av = pytest.importorskip("av")
    with av.open(str(path), "w") as container:
        stream = container.add_stream("mpeg4", rate=10)
        stream.width, stream.height, stream.pix_fmt = 160, 128, "yuv420p"
        stream.bit_rate = 4_000_000
        for pixels in frames:
            for packet in stream.encode(av.VideoFrame.from_ndarray(pixels, format="rgb24")):
                container.mux(packet)
        for packet in stream.encode():
            container.mux(packet)


def test_the_sharpest_frame_of_each_window_is_taken(tmp_path):
    sharp = picture(128, 160) // 2
    blurred = gaussian_filter(sharp, (4, 4, 0))
    # the brightness tells which frame it is
    frames = [(sharp if index % 4 == 2 else blurred) + np.uint8(10 * index) for index in range(12)]
    film(tmp_path / "a.mp4", frames)
    progress = Lines()
    extract_frames(tmp_path / "a.mp4", tmp_path / "frames", 3, progress)
    written = sorted((tmp_path / "frames").iterdir())
    assert [path.name for path in written] == [f"frame_{index:06d}.jpg" for index in range(3)]
    shown = [(read_image(path).mean() - sharp.mean()) / 10 for path in written]
    assert np.abs(np.array(shown) - (2, 6, 10)).max() < 0.5
    extract_frames(tmp_path / "a.mp4", tmp_path / "frames", 2, Lines())
    assert len(list((tmp_path / "frames").iterdir())) == 2


def test_what_is_not_a_video_is_refused(tmp_path):
    pytest.importorskip("av")
    (tmp_path / "a.mp4").write_bytes(b"nothing" * 100)
    with pytest.raises(InputError, match="not a video that can be decoded"):
        extract_frames(tmp_path / "a.mp4", tmp_path / "frames", 3, Lines())
    check_video(tmp_path / "a.mp4")
    with pytest.raises(InputError, match="no such file"):
        check_video(tmp_path / "b.mp4")
