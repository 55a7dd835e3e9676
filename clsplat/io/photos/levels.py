"""The range of the samples of grey photos with 16 bits, as thermal cameras write them.

Temperatures fill a hundredth of what 16 bits hold: divided by 257, they would be four levels of
grey. All photos of a set are stretched alike, so that a surface keeps its grey from view to view.
"""

from collections.abc import Sequence

import numpy as np

from clsplat.io.photos.photo import Levels, Source, opened

MOST_READ = 32  # photos, evenly chosen, whose samples are looked at
SHARES = (0.1, 99.9)  # per cent of a photo's samples, between which they count
FEWEST_STEPS = 64.0  # of 8 bits that samples fill, with which they are left as they are


def common_levels(sources: Sequence[Source], deep: Sequence[bool]) -> list[Levels | None]:
    """For each photo the lowest and the greatest sample that count in the whole set; None for those
    that are read as they are, because they fill 8 bits anyway or have other samples.

    Parameters
    ----------
    sources : of photos, as `photo.opened` takes them.
    deep : whether each is grey with 16 bits, as `photo.Photo` has it.
    """
    read = [source for source, is_deep in zip(sources, deep) if is_deep]
    ends = []
    for source in read[::-(-len(read) // MOST_READ) or 1]:
        with opened(source) as photo:
            ends.append(np.percentile(photo.samples(), SHARES))
    low, high = (float(np.min(ends)), float(np.max(ends))) if ends else (0.0, 0.0)
    is_narrow = 0 < high - low < 257 * FEWEST_STEPS
    return [(low, high) if is_deep and is_narrow else None for is_deep in deep]


def levels_note(levels: Sequence[Levels | None]) -> str:
    """A line for the user on photos that are stretched; "" if none is."""
    known = [each for each in levels if each]
    if not known:
        return ""
    return (f"{len(known)} of {len(levels)} photos are grey with 16 bits, of which they use "
            f"{known[0][0]:.0f} to {known[0][1]:.0f}: all are stretched alike to 8 bits")
