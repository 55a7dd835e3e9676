"""The schedule of DashGaussian (Chen et al. 2025): resolution follows the photos' spectra.

Before training, the spectra tell how much of the photos a smaller image contains; each resolution
gets steps in proportion to what it adds. The number of gaussians follows the resolution, towards a
final number that grows with the number of gaussians above the growth threshold.

Where the publication leaves a choice: the target of a round is that of the factor in use, an
integer; growth by a fifth is counted from what pruning leaves; no image is smaller than a tile.
"""

from __future__ import annotations

import dataclasses
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from clsplat.schedule.constant import Constant
from clsplat.schedule.plan import AS_PUBLISHED, Plan, SceneFacts

if TYPE_CHECKING:
    from clsplat.densify.grow import Growth
    from clsplat.densify.round import Round
    from clsplat.options import ScheduledOptions

LARGEST_FACTOR = 8
TILE = 16  # pixels
CURVE_POINTS = 32  # of the resolution curve
START_SHARE = 1 / 4  # of a photo's spectrum that the smallest image must contain
BINS = 1024  # in a spectrum
LEAST_GAIN = 1e-3  # of a spectrum; less may be rounding
MOMENTUM, MOST_ADDED = 0.98, 10**6  # of the final number of gaussians
FIRST_GROWTH = 5  # the first final number is the initial one times (1 + this)
AHEAD_POINTS = 64  # of the curve, in a prediction
GROWS_SHARE = 0.9  # of the run
MOST_GROWTH = 5  # a round adds at most one gaussian for each so many


class Dash(Constant):
    """Images grow from small to full size until `densify_until`.

    The position rate decays only once the factor is below 2. Rounds of growth are those of 3DGS,
    but none prunes large gaussians.
    """

    defaults = {**AS_PUBLISHED, "reset_every": 3000}
    parts = frozenset({"levels"})
    keeps = ("factor", "decay_began", "final_growth")
    fills_target = True

    @classmethod
    def grows_until(cls, options: ScheduledOptions) -> int:
        return int(GROWS_SHARE * options.iterations)

    @classmethod
    def planned_levels(cls, options: ScheduledOptions, facts: SceneFacts) -> tuple[None, str]:
        return None, "computed from the photos' spectra when training begins"

    def __init__(self, options: ScheduledOptions, facts: SceneFacts) -> None:
        super().__init__(options, facts)
        self.times, self.sharpness = resolution_curve(facts)
        self.factor = self._factor(0)
        self.levels = tuple(float(factor) for factor in range(self.factor, 0, -1))
        self.decay_began: int | None = None  # steps taken before the decay
        self.final_growth = FIRST_GROWTH * facts.count

    def scale(self, steps: float) -> float:
        """The down-sampling factor after `steps` steps, before it is rounded down."""
        until = self.options.densify_until
        if steps >= until:
            return 1.0
        return float(float(np.interp(steps / until, self.times, self.sharpness)) ** -0.5)

    def _factor(self, steps: float) -> int:
        return int(self.scale(steps) + 1e-9)  # 1 / sqrt(1 / 9) may fall short of 3

    def plan(self, iteration: int) -> Plan:
        """See `Schedule.plan`. The factor changes with rounds of growth only, and never rises."""
        plan, steps = super().plan(iteration), iteration - 1
        # after the round, which uses statistics gathered at the factor before
        grew = iteration > 1 and super().plan(iteration - 1).grows
        if grew or steps >= self.options.densify_until:
            self.factor = min(self.factor, self._factor(steps))
        if self.factor < 2 and self.decay_began is None:
            self.decay_began = steps
        return dataclasses.replace(plan, level=float(self.factor), prunes_large=False, decay=self.decay(iteration))

    def decay(self, iteration: int) -> float:
        """See `Schedule.decay`: only from where the factor falls below 2."""
        if self.decay_began is None:
            return 0.0
        steps, left = iteration - 1 - self.decay_began, self.options.iterations - self.decay_began
        return min(1.0, steps / max(1, left))

    def target(self, iteration: int, count: int, above: int) -> int:
        """See `Schedule.target`; each call raises the final number."""
        o, steps, initial = self.options, iteration - 1, self.facts.count
        self.final_growth = max(self.final_growth, int(MOMENTUM * self.final_growth + min(MOST_ADDED, above)))
        growth = self.final_growth
        if o.max_gaussians:
            growth = min(growth, o.max_gaussians - initial)
        if steps + o.densify_every < o.densify_until:
            growth /= self.factor ** (2 - steps / o.densify_until)
        return max(count, min(initial + int(growth), count + count // MOST_GROWTH))

    def grow(self, round: Round) -> Growth:
        """See `Schedule.grow`; those of the highest gradients grow, whatever the threshold is."""
        room = self.room(round, round.prunes)
        assert room is not None  # there is a target
        return round.densify(round.highest(room))

    def ahead(self, iteration: int) -> list[tuple[float, float]]:
        """See `Schedule.ahead`: along the curve."""
        left = self.options.iterations - iteration
        places = iteration + left * (np.arange(AHEAD_POINTS) + 0.5) / AHEAD_POINTS
        return [(float(max(1, self._factor(place))), left / AHEAD_POINTS) for place in places]


def resolution_curve(facts: SceneFacts) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The resolution over time, a piecewise linear curve that ends at full resolution.

    Training starts at the factor at which a photo's spectrum contains a quarter of its sum, for the
    photo whose factor is smallest, and at no more than 8. What the mean spectrum gains from there
    to full resolution is divided evenly; a share of the gain is reached when its logarithm is.
    Returns shares of the steps until `densify_until`, and 1 / factor^2 at them, float64[32] or [1].
    """
    grid = np.arange(BINS + 1) / BINS  # 1 / factor
    total = np.zeros(BINS + 1)
    start = 1 / max(1, min(LARGEST_FACTOR, min(facts.size) / TILE))
    for photo in facts.photos():
        spectrum = cumulative_spectrum(photo)
        start = max(start, np.interp(START_SHARE * spectrum[-1], spectrum, grid))
        total += spectrum
    first, whole = np.interp(start, grid, total), total[-1]
    if whole - first <= LEAST_GAIN * whole:  # flat photos, or too small for any other factor
        return np.zeros(1), np.ones(1)
    gains = np.linspace(first, whole, CURVE_POINTS)
    inverse = np.interp(gains, total, grid)
    inverse[0], inverse[-1] = start, 1
    return np.log(gains / first) / np.log(whole / first), inverse**2


def cumulative_spectrum(photo: NDArray[np.uint8]) -> NDArray[np.float64]:
    """Sums [1025] of the absolute spectrum of a photo [3, H, W] within centred windows of growing
    size; window k has k / 1024 of the width and height of the spectrum."""
    _, height, width = photo.shape
    across, down = np.fft.rfftfreq(width), np.abs(np.fft.fftfreq(height))
    bins = np.ceil(2 * BINS * np.maximum(across, down[:, None])).astype(np.int64).ravel()
    # rfft2 omits the mirror image of each column that is not its own mirror image
    twice = np.where((across > 0) & (across < 0.5), 2.0, 1.0)
    sums = np.zeros(BINS + 1)
    for channel in photo:  # one at a time: a spectrum is eight times the size of its photo
        spectrum = np.abs(np.fft.rfft2(channel.astype(np.float32))) * twice
        sums += np.bincount(bins, spectrum.ravel(), BINS + 1)
    return np.cumsum(sums)
