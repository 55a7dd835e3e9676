"""Work that is enqueued without waiting, and done again where an array turns out to be too small.

The arrays of a frame have room for what views were seen to need. The first frame that needs more
fails: it sets COUNT_FAILED in `counts`, and from then on no kernel changes what outlives a frame
(cl/include/counts.h). The host notices at the next `confirm`, makes room and repeats all units from
the failed one on, in their order. So the numbers do not depend on the room.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from clsplat import constants
from clsplat.device import ArraySpec, Device, Reading

FEW_PENDING = 8
MOST_PENDING = 100  # units; the counts are read twice as often, and looked at one reading later
WRAP = 2**32
COUNTS = ArraySpec((constants.FRAME_COUNTS,), np.uint32)


class Unit(NamedTuple):
    """The work of one frame."""

    work: Callable[[], None]  # enqueues it; COUNT_DONE counts the units that are done
    # called with COUNT_FAILED once the unit has failed, when all before are done
    make_room: Callable[[int], None]


class Units:
    """The units that were submitted and are not known to be done."""

    def __init__(self, device: Device) -> None:
        self.counts = device.zeros(*COUNTS)  # for all frames of the units
        self.most_pending = MOST_PENDING  # `submit` then waits for the first half of them
        self._pending, self._done = list[Unit](), 0
        self._reading: Reading | None = None
        self._since_reading = 0
        self.poll_soon()

    def submit(self, unit: Unit) -> None:
        """Run a unit."""
        unit.work()
        self._pending.append(unit)
        self._since_reading += 1
        if self._since_reading < min(self._patience, self.most_pending // 2):
            return
        # what was asked for so many units ago is there: the queue never runs dry
        if self._reading and not self._drop_done(self._reading.values()):
            self.confirm()
        self._reading, self._since_reading = Reading(self.counts), 0
        self._patience *= 2

    def poll_soon(self) -> None:
        """Look at the counts soon: all that is queued behind a frame that failed is redone."""
        self._patience = FEW_PENDING

    def confirm(self) -> NDArray[np.uint32]:
        """Make sure that all units are done; waits. Returns the counts."""
        self._reading, self._since_reading = None, 0
        read: NDArray[np.uint32] = self.counts.download()
        while not self._drop_done(read):
            assert self._pending, "a frame failed that is of no unit"
            failed = int(read[constants.COUNT_FAILED])
            read[[constants.COUNT_FAILED, constants.COUNT_NEEDED_VISIBLE, constants.COUNT_NEEDED_PAIRS]] = 0
            self.counts.write(read)
            self.poll_soon()
            self._pending[0].make_room(failed)
            for unit in self._pending:
                unit.work()
            read = self.counts.download()
        assert not self._pending, "a unit neither failed nor was done"
        return read

    def _drop_done(self, read: NDArray[np.uint32]) -> bool:
        """Forget the units that are done by the counts; whether none has failed."""
        done = (int(read[constants.COUNT_DONE]) - self._done) % WRAP
        self._pending, self._done = self._pending[done:], int(read[constants.COUNT_DONE])
        return not read[constants.COUNT_FAILED]
