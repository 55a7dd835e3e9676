"""The forecast of memory follows the room of frames (clsplat/training/rooms.py)."""

from types import SimpleNamespace

from clsplat.estimate import memory


def test_sizes_that_need_no_bands_have_the_same_room(item_device, monkeypatch):
    monkeypatch.setattr(memory, "pair_limit", lambda *_: 1000)
    cameras = [SimpleNamespace(width=width, height=48) for width in (64, 32, 96)]
    views = [SimpleNamespace(camera=camera) for camera in cameras]
    frames = SimpleNamespace(indices=[0, 1, 2], at=lambda count: [[50, 300], [20, 100], [60, 2000]])
    prepared = SimpleNamespace(options=SimpleNamespace(engine="device"))
    wide, narrow, banded = memory._sizes(item_device, prepared, views, frames, 70)
    assert wide.pairs == narrow.pairs == 420 + 6 * 3 and banded.pairs == 2000
    assert wide.splats == narrow.splats == banded.splats == 70
    assert (narrow.width, narrow.height) == (32, 48)
