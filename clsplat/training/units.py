"""Work that is enqueued without waiting, and done again where an array turns out to be too small.

The arrays of a frame have room for what views were seen to need. The first frame that needs more
fails: it sets COUNT_FAILED in `counts`, and from then on no kernel changes what outlives a frame
(cl/include/counts.h). The host notices at the next `confirm`, makes room and repeats all units from
the failed one on, in their order. So the numbers do not depend on the room.
"""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from clsplat.constants import (
    COUNT_DONE,
    COUNT_FAILED,
    COUNT_NEEDED_PAIRS,
    COUNT_NEEDED_VISIBLE,
    FRAME_COUNTS,
)
from clsplat.device import ArraySpec, Device

Unit = Callable[[], None]  # enqueues the work of one frame; COUNT_DONE counts those that are done
FEW_PENDING = 8
MOST_PENDING = 50  # units, between two looks at the counts
WRAP = 2**32
COUNTS = ArraySpec((FRAME_COUNTS,), np.uint32)


class Units:
    """The units that were submitted and are not known to be done.

    Parameters
    ----------
    device : of the work.
    make_room : called with the failed unit, between which and the next nothing is pending.

    Attributes
    ----------
    counts : uint[FRAME_COUNTS], for all frames of the units.
    most_pending : units after which `submit` looks at the counts; fewer after `hurry`.
    """

    def __init__(self, device: Device, make_room: Callable[[Unit], None]) -> None:
        self.counts = device.zeros(*COUNTS)
        self.most_pending = MOST_PENDING
        self._make_room, self._pending, self._done = make_room, list[Unit](), 0
        self._patience = FEW_PENDING

    def submit(self, unit: Unit) -> None:
        """Run a unit."""
        unit()
        self._pending.append(unit)
        if len(self._pending) >= min(self._patience, self.most_pending):
            self._patience *= 2
            self.confirm()

    def hurry(self) -> None:
        """Look at the counts soon, as the room is new: units after one that failed are in vain."""
        self._patience = FEW_PENDING

    def confirm(self) -> NDArray[np.uint32]:
        """Make sure that all units are done; waits. Returns the counts."""
        read: NDArray[np.uint32] = self.counts.download()
        while self._pending:
            done = (int(read[COUNT_DONE]) - self._done) % WRAP
            self._pending, self._done = self._pending[done:], int(read[COUNT_DONE])
            if not self._pending:
                break
            assert read[COUNT_FAILED], "a unit neither failed nor was done"
            read[[COUNT_FAILED, COUNT_NEEDED_VISIBLE, COUNT_NEEDED_PAIRS]] = 0
            self.counts.write(read)
            self.hurry()
            self._make_room(self._pending[0])
            for unit in self._pending:
                unit()
            read = self.counts.download()
        return read
