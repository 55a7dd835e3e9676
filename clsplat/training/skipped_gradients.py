"""Counts gradients that are not finite, whose rows the device skips.

cl/project.cl skips rows of gaussians, cl/exposure.cl colour transforms of views. Only an occasional
poll waits for the device.
"""

from clsplat.device import Array

# Share of the rows between two records above which training stops. Good runs skip none, and a few
# broken gaussians cause some in a million. A skipped gaussian does not change, and its neighbours
# learn to compensate: with one in a hundred the result is no longer the scene.
TOO_MANY = 0.01


class SkippedGradients:
    """Counts skipped rows over a run.

    Parameters
    ----------
    counters : uint[1] on the device; rows skipped by one kernel, modulo 2^32.

    Attributes
    ----------
    total : rows skipped in the whole run, at the last `poll`.
    requested : rows of gradients in the whole run, at the last `poll`.
    """

    def __init__(self, *counters: Array) -> None:
        self._counters = counters
        self._counted = self._requested = 0  # by the counters, and requested, at the last poll
        self.total = self.requested = self._closed = self._closed_requested = 0

    def poll(self, requested: int) -> bool:
        """Update the attributes, and tell whether these are the first skipped rows; waits.

        Parameters
        ----------
        requested : rows of gradients that this process requested so far.
        """
        before, counted = self.total, sum(int(counter.last()) for counter in self._counters)
        self.total += (counted - self._counted) % 2**32
        self.requested += requested - self._requested
        self._counted, self._requested = counted, requested
        return self.total > before == 0

    def close(self) -> tuple[int, int]:
        """(skipped, requested) rows between the last `close` and the last `poll`."""
        since = self.total - self._closed, self.requested - self._closed_requested
        self._closed, self._closed_requested = self.total, self.requested
        return since

    def state(self) -> dict[str, int]:
        """State for a checkpoint, at the last `poll`."""
        return {"total": self.total, "closed": self._closed,
                "asked": self.requested - self._closed_requested}

    def load(self, state: dict[str, int]) -> None:
        """Restore what `state` returned."""
        self.total, self._closed = state["total"], state["closed"]
        self.requested, self._closed_requested = state["asked"], 0
