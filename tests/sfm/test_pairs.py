"""Which pairs are matched, by what is known of the photos."""

import numpy as np

from clsplat.sfm import pairs
from clsplat.sfm.pairs import _shared_features, choose_pairs
from tests.sfm.cases import Lines, source


def located(count, spacing=1e-4):
    return [source(f"{index:03d}.jpg", latitude=45.0, longitude=7 + spacing * index)
            for index in range(count)]


def test_few_photos_are_matched_all_with_all():
    rows, reason = choose_pairs(None, [source() for _ in range(5)], "auto", Lines())
    assert rows.tolist() == [[a, b] for a in range(5) for b in range(a + 1, 5)]
    assert reason == "all 10 pairs of 5 photos"


def test_neighbours_by_gps():
    photos = located(60)
    rows, reason = choose_pairs(None, photos, "auto", Lines())
    assert "by GPS" in reason
    apart = rows[:, 1] - rows[:, 0]
    assert apart.min() == 1 and apart.max() <= pairs.NEIGHBOURS
    assert {(0, 1), (30, 31), (58, 59), (20, 26)} <= set(map(tuple, rows.tolist()))


def test_videos_and_unknown_photos_are_compared_by_their_largest_features(monkeypatch):
    rng = np.random.default_rng(0)
    kinds = [rng.normal(size=(12, 128)).astype(np.float32) for _ in range(2)]
    kinds = [kind / np.linalg.norm(kind, axis=1, keepdims=True) for kind in kinds]
    monkeypatch.setattr(pairs, "_largest", lambda database, count: np.array([
        kinds[index % 2] for index in range(count)]))
    photos = [source() for _ in range(50)]
    rows, reason = choose_pairs(None, photos, "auto", Lines())
    assert reason.endswith("of similar content")
    far = rows[rows[:, 1] - rows[:, 0] > pairs.BEFORE_AND_AFTER]
    assert len(far) and not np.any((far[:, 1] - far[:, 0]) % 2)
    rows, reason = choose_pairs(None, photos, "sequence", Lines())
    assert "follow each other" in reason and [0, 9] in rows.tolist()


def test_shared_features():
    rng = np.random.default_rng(1)
    first = rng.normal(size=(30, 128)).astype(np.float32)
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    other = rng.normal(size=(30, 128)).astype(np.float32)
    other /= np.linalg.norm(other, axis=1, keepdims=True)
    half = np.concatenate([first[:10], other[10:]])
    equal, ten, none = _shared_features(first, np.array([first[::-1], half, other]))
    assert equal == 30 and 10 <= ten < 15 and none < 5
    few = np.concatenate([first[:10], np.zeros_like(first[10:])])
    assert _shared_features(few, np.array([first, 0 * first])).tolist() == [10, 0]
