"""Which pairs are matched, by what is known of the photos."""

import numpy as np
import pycolmap

from clsplat.sfm import pairs
from clsplat.sfm.features import create_database, image_id
from clsplat.sfm.pairs import choose_pairs
from clsplat.sfm.photos import cameras_of
from tests.sfm.cases import Lines, source, unit_descriptors


def located(count, spacing=1e-4):
    return [source(f"{index:03d}.jpg", latitude=45.0, longitude=7 + spacing * index) for index in range(count)]


def test_few_photos_are_matched_all_with_all():
    rows, reason = choose_pairs(None, [source() for _ in range(5)], "auto", None, Lines())
    assert rows.tolist() == [[a, b] for a in range(5) for b in range(a + 1, 5)]
    assert reason == "all 10 pairs of 5 photos"


def test_neighbours_by_gps():
    photos = located(60)
    rows, reason = choose_pairs(None, photos, "auto", None, Lines())
    assert "by GPS" in reason
    apart = rows[:, 1] - rows[:, 0]
    assert apart.min() == 1 and apart.max() <= pairs.NEIGHBOURS
    assert {(0, 1), (30, 31), (58, 59), (20, 26)} <= set(map(tuple, rows.tolist()))


def test_videos_and_unknown_photos_are_compared_by_their_largest_features(tmp_path, item_device):
    """Of two places that the photos show in turn, and a damaged photo."""
    photos = [source(f"{index:02d}.jpg") for index in range(50)]
    path = tmp_path / "d.db"
    create_database(path, cameras_of(photos))
    rng = np.random.default_rng(0)
    kinds = [unit_descriptors(rng, 40) for _ in range(2)]
    with pycolmap.Database.open(path) as database:
        for index in range(49):
            described = pycolmap.FeatureDescriptors()
            described.data = kinds[index % 2]
            database.write_keypoints(image_id(index), np.zeros((40, 4), np.float32))
            database.write_descriptors(image_id(index), described)
    progress = Lines()
    rows, reason = choose_pairs(path, photos, "auto", item_device, progress)
    assert reason.endswith("of similar content")
    far = rows[rows[:, 1] - rows[:, 0] > pairs.BEFORE_AND_AFTER]
    assert len(far) and not np.any((far[:, 1] - far[:, 0]) % 2) and not np.any(far == 49)
    assert progress.counts[-1] == ("comparing pair", 1225, 1225)
    rows, reason = choose_pairs(path, photos, "sequence", item_device, progress)
    assert "follow each other" in reason and [0, 9] in rows.tolist()
