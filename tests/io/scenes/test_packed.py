"""A packed scene equals its original, and a damaged one is refused."""

import numpy as np
import pytest

from clsplat.errors import InputError
from clsplat.io.photos.images import image_size, read_image
from clsplat.io.photos.resample import resample
from clsplat.io.scenes.packed import read_packed, write_packed
from clsplat.io.scenes.read import fingerprint, read_scene
from tests.data.tiny_model import write_scene


@pytest.fixture
def scene(tmp_path):
    return read_scene(write_scene(tmp_path / "town"))


def test_round_trip_is_exact(tmp_path, scene):
    write_packed(scene, tmp_path / "town.npz")
    packed = read_scene(tmp_path / "town.npz")
    assert packed.name == "town" and fingerprint(packed) == fingerprint(scene)
    assert packed.observations.dtype == np.int32
    assert np.array_equal(packed.observations, scene.observations)
    for view, original in zip(packed.views, scene.views, strict=True):
        assert view.source == original.source.read_bytes()
    write_packed(packed, tmp_path / "again.npz")
    assert (tmp_path / "again.npz").read_bytes() == (tmp_path / "town.npz").read_bytes()


def test_downscale(tmp_path, scene):
    write_packed(scene, tmp_path / "town.npz", downscale=2.6)
    packed = read_packed(tmp_path / "town.npz")
    for view, original in zip(packed.views, scene.views, strict=True):
        camera = view.camera
        assert (camera.width, camera.height) == (18, 13) == image_size(view.source)
        assert camera.focal == pytest.approx((50 * 18 / 48, 52 * 13 / 36))
        expected = resample(read_image(original.source), (18, 13)).astype(int)
        assert np.abs(read_image(view.source) - expected).max() <= 2
    assert np.array_equal(packed.points, scene.points)
    assert np.array_equal(packed.offset, scene.offset)
    assert np.array_equal(packed.observations, scene.observations)


def test_a_packed_scene_without_offset_is_recentred(tmp_path, scene):
    write_packed(scene, tmp_path / "town.npz")
    arrays = dict(np.load(tmp_path / "town.npz"))
    del arrays["offset"]
    arrays["xyz"] = arrays["xyz"] + 7
    np.savez(tmp_path / "plain.npz", **arrays)
    packed = read_packed(tmp_path / "plain.npz")
    assert np.allclose(packed.points, scene.points) and np.allclose(packed.offset, 7)


@pytest.mark.parametrize("change", [lambda a: a.pop("observations"),
                                    lambda a: a.update(observations=a["observations"][:0])])
def test_a_packed_scene_without_tracks_has_no_observations(tmp_path, scene, change):
    write_packed(scene, tmp_path / "town.npz")
    arrays = dict(np.load(tmp_path / "town.npz"))
    change(arrays)
    np.savez(tmp_path / "plain.npz", **arrays)
    packed = read_packed(tmp_path / "plain.npz")
    assert packed.observations is None and fingerprint(packed) == fingerprint(scene)
    write_packed(packed, tmp_path / "again.npz")
    assert "observations" not in np.load(tmp_path / "again.npz").files


def test_views_are_sorted_by_name(tmp_path, scene):
    write_packed(scene, tmp_path / "town.npz")
    arrays = dict(np.load(tmp_path / "town.npz"))
    sizes = arrays["sizes"]
    photos = np.split(arrays["jpeg"], np.cumsum(sizes)[:-1])
    for key in ("names", "V", "K", "wh", "sizes"):
        arrays[key] = arrays[key][::-1]
    arrays["jpeg"] = np.concatenate(photos[::-1])
    seen = scene.observations[::3]
    mirrored = np.concatenate([seen, seen[:5]])[::-1] * (1, -1) + (0, 3)  # and five twice
    arrays["observations"] = mirrored.astype(np.uint16)
    np.savez(tmp_path / "back.npz", **arrays)
    packed = read_packed(tmp_path / "back.npz")
    assert fingerprint(packed) == fingerprint(scene)
    assert np.array_equal(packed.observations, seen)
    assert [v.source for v in packed.views] == [v.source.read_bytes() for v in scene.views]


def refused(path, *words):
    with pytest.raises(InputError) as caught:
        read_packed(path)
    message = str(caught.value)
    assert path.name in message and "\n" not in message
    for word in words:
        assert word in message, message


@pytest.mark.parametrize("share", [0, 0.001, 0.3, 0.8, 0.99, 1])
def test_truncated(tmp_path, scene, share):
    path = tmp_path / "town.npz"
    write_packed(scene, path)
    data = path.read_bytes()
    path.write_bytes(data[:min(int(share * len(data)), len(data) - 1)])
    refused(path, "copy it again")


def test_a_flipped_bit(tmp_path, scene):
    path = tmp_path / "town.npz"
    write_packed(scene, path)
    data = bytearray(path.read_bytes())
    data[data.index(scene.points.tobytes()) + 5] ^= 1
    path.write_bytes(data)
    refused(path, "damaged")


@pytest.mark.parametrize("key, change, word", [
    ("xyz", lambda a: np.where(a == a[3], np.nan, a), "points are not finite"),
    ("xyz", lambda a: a * 0, "one place"),
    ("xyz", lambda a: a[:0], "do not fit"),
    ("V", lambda a: a + np.inf, "pose"),
    ("V", lambda a: a * 2, "not a rotation"),
    ("V", lambda a: a * np.diag([-1, 1, 1, 1]).sum(1)[:, None], "not a rotation"),  # a mirror
    ("K", lambda a: -a, "no focal length"),
    ("K", lambda a: a[:2], "do not fit"),
    ("sizes", lambda a: a + 1, "do not fit"),
    ("sizes", lambda a: -a, "do not fit"),
    ("wh", lambda a: a + 1, "photo has 48x36"),
    ("names", lambda a: np.repeat(a[:1], len(a)), "twice"),
    ("names", lambda a: np.char.add("../", a), "leaves"),
    ("names", lambda a: a.astype(object), "not a packed scene"),
    ("jpeg", lambda a: a[::-1], "not an image"),
    ("offset", lambda a: a * np.nan, "do not fit"),
    ("rgb", lambda a: a.astype(float), "'rgb' is float64"),
    ("jpeg", None, "'jpeg' is missing"),
    ("observations", lambda a: a + (1, 0), "observations name a point"),
    ("observations", lambda a: a - (1, 0), "observations name a point"),
    ("observations", lambda a: a + (0, 1), "observations name a point"),
    ("observations", lambda a: a - (0, 1), "observations name a point"),
    ("observations", lambda a: np.full_like(a, 2**64 - 1, np.uint64), "observations name a point"),
    ("observations", lambda a: a[:, :1], "'observations' is int32"),
    ("observations", lambda a: a.astype(float), "'observations' is float64"),
])
def test_bad_arrays(tmp_path, scene, key, change, word):
    write_packed(scene, tmp_path / "town.npz")
    arrays = dict(np.load(tmp_path / "town.npz"))
    if change is None:
        del arrays[key]
    else:
        arrays[key] = change(arrays[key])
    np.savez(tmp_path / "bad.npz", **arrays)
    with pytest.raises(InputError, match=word):
        read_packed(tmp_path / "bad.npz")


def test_not_a_packed_scene(tmp_path):
    refused(tmp_path / "missing.npz", "no such file")
    np.save(tmp_path / "array.npz", np.zeros(3))
    (tmp_path / "array.npz.npy").rename(tmp_path / "array.npz")
    refused(tmp_path / "array.npz", "not a packed scene")
