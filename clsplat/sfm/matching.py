"""Matches the features of pairs of photos and checks them by the geometry of two views."""

import shutil
from pathlib import Path

import pycolmap

from clsplat.errors import InputError
from clsplat.sfm.database import image_id, image_name
from clsplat.sfm.features import threads
from clsplat.sfm.pairs import Pairs
from clsplat.sfm.progress import Progress

LEAST_FREE_BYTES = 1 << 26  # on the disk: more than the matches of so many pairs take
PAIRS_AT_ONCE = 64  # after which they are in the database, so that a killed command keeps them


def match_pairs(database: Path, pairs: Pairs, progress: Progress) -> None:
    """Match pairs of photos, except those that the database has already.

    Parameters
    ----------
    database : with the features of the photos; its folder is used for a temporary list.

    Raises
    ------
    InputError : the disk is nearly full, in which case pycolmap would end the process.
    """
    options = pycolmap.FeatureMatchingOptions()
    options.use_gpu, options.num_threads = False, threads()
    geometry = pycolmap.TwoViewGeometryOptions()
    geometry.ransac.random_seed = 0
    missing = _missing(database, pairs)
    listed = pycolmap.ImportedPairingOptions()
    listed.match_list_path = database.with_name("pairs.txt")
    done = len(pairs.rows) - len(missing)
    for begin in range(0, len(missing), PAIRS_AT_ONCE):
        progress.count("matching pair", done + begin, len(pairs.rows))
        if shutil.disk_usage(database.parent).free < LEAST_FREE_BYTES:
            raise InputError(f"{database.parent}: the disk is nearly full; free some space, and "
                             "give the command again, which goes on from here")
        some = missing[begin:begin + PAIRS_AT_ONCE]
        listed.match_list_path.write_text("".join(
            f"{image_name(first)} {image_name(second)}\n" for first, second in some), "utf-8")
        pycolmap.match_image_pairs(database, options, listed, geometry, pycolmap.Device.cpu)
    progress.count("matching pair", len(pairs.rows), len(pairs.rows))


def _missing(path: Path, pairs: Pairs) -> list[tuple[int, int]]:
    """The pairs that were not matched yet, of photos that have features."""
    database = pycolmap.Database.open(path)
    try:
        has_features = {index for index in set(pairs.rows.ravel().tolist())
                        if database.exists_descriptors(image_id(index))}
        return [(first, second) for first, second in pairs.rows.tolist()
                if first in has_features and second in has_features
                and not database.exists_two_view_geometry(image_id(first), image_id(second))]
    finally:
        database.close()
