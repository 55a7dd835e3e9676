"""Gradients that are not finite: the device skips their rows and counts them (cl/project.cl, and
cl/exposure.cl, whose rows are colour transforms of views).

The host counts the rows it asked for, so nothing waits for the device but a poll now and then.
"""

from clsplat.device import Array

# Share of the rows between two records above which training stops. Runs that go well skip none, a
# few broken gaussians make some in a million. A skipped gaussian stays as it is, and all that it
# overlaps learns to make up for it: with one in a hundred the result is no longer the scene.
TOO_MANY = 0.01


class SkippedGradients:
    """Counts them over a run.

    Parameters
    ----------
    counters : uint[1] each on the device, rows skipped since it was made, modulo 2^32.

    Attributes
    ----------
    total : rows skipped in the whole run, as of the last `poll`.
    asked : rows of gradients since the last `close`, to be kept up to date.
    """

    def __init__(self, *counters: Array) -> None:
        self._counters = counters
        self._counted = 0  # by all counters, as of the last look
        self.total = self.asked = self._closed = 0

    def poll(self) -> bool:
        """Bring `total` up to date, and whether it has left zero; waits."""
        before, counted = self.total, sum(int(counter.last()) for counter in self._counters)
        self.total += (counted - self._counted) % 2**32
        self._counted = counted
        return self.total > before == 0

    def close(self) -> tuple[int, int]:
        """(skipped, asked) since the last `close`, as of the last `poll`."""
        since = self.total - self._closed, self.asked
        self._closed, self.asked = self.total, 0
        return since

    def state(self) -> dict[str, int]:
        """What a checkpoint must hold, for JSON, as of the last `poll`."""
        return {"total": self.total, "closed": self._closed, "asked": self.asked}

    def load(self, state: dict[str, int]) -> None:
        """Go on from the `state` that a checkpoint held."""
        self.total, self._closed, self.asked = state["total"], state["closed"], state["asked"]
