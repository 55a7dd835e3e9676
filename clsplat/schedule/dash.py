"""The schedule of DashGaussian (Chen et al. 2025): resolution follows the photos' spectra.

Once, before training, the spectra say how much of the photos a smaller image holds; steps are
shared out by how much each resolution adds. The number of gaussians follows the resolution, towards
a final number that grows with how many gaussians ask for more.

Where the publication leaves room: the target of a round is that of the factor in use, a whole
number; growth by a fifth is counted from what pruning leaves; no image is trained on at less than
a tile a side.
"""

import dataclasses

import numpy as np

from clsplat.schedule.constant import Constant

LARGEST_FACTOR = 8
TILE = 16  # pixels
STEPS = 32  # sample points of the resolution curve
START_SHARE = 1 / 4  # of a photo's spectrum, which the smallest image must hold
BINS = 1024  # of a spectrum
LEAST_GAIN = 1e-3  # of a spectrum: less is nothing, or rounding
MOMENTUM, MOST_ADDED = 0.98, 10**6  # of the final number of gaussians
FIRST_GROWTH = 5  # final number to begin with: initial gaussians times (1 + this)
AHEAD = 64  # samples of the curve
GROWS_SHARE = 0.9  # of the run
MOST_GROWTH = 5  # a round adds at most one gaussian in so many


class Dash(Constant):
    """Images from small to large, until `densify_until`; the position rate decays only from where
    the factor falls below 2. Rounds of growth are those of 3DGS, but none prunes large ones."""

    defaults = {"reset_every": 3000, "exposure": "off"}
    parts = frozenset({"levels"})
    selection = "highest"

    @classmethod
    def grows_until(cls, options):
        return int(GROWS_SHARE * options.iterations)

    @classmethod
    def planned_levels(cls, options, size):
        return None, "found in the photos' spectra, where training begins"

    def __init__(self, options, facts):
        super().__init__(options, facts)
        self.times, self.sharpness = resolution_curve(facts)
        self.factor = self._factor(0)
        self.levels = tuple(float(factor) for factor in range(self.factor, 0, -1))
        self.decay_began = None  # steps taken before
        self.final_growth = FIRST_GROWTH * facts.count

    def scale(self, steps):
        """The down-sampling factor after so many steps, before it is rounded down."""
        until = self.options.densify_until
        if steps >= until:
            return 1.0
        return float(np.interp(steps / until, self.times, self.sharpness)) ** -0.5

    def _factor(self, steps):
        return int(self.scale(steps) + 1e-9)  # 1 / sqrt(1 / 9) may fall short of 3

    def plan(self, iteration):
        """See `Schedule.plan`. The factor changes with rounds of growth only, and never rises."""
        plan, steps = super().plan(iteration), iteration - 1
        # after the round, which goes by statistics of the factor before
        grew = iteration > 1 and super().plan(iteration - 1).grows
        if grew or steps >= self.options.densify_until:
            self.factor = min(self.factor, self._factor(steps))
        if self.factor < 2 and self.decay_began is None:
            self.decay_began = steps
        return dataclasses.replace(plan, level=float(self.factor), prunes_large=False,
                                   decay=self.decay(iteration))

    def decay(self, iteration):
        if self.decay_began is None:
            return 0.0
        steps, left = iteration - 1 - self.decay_began, self.options.iterations - self.decay_began
        return min(1.0, steps / max(1, left))

    def target(self, iteration, count, above):
        """See `Schedule.target`; to be asked once a round: it moves the final number."""
        o, steps, initial = self.options, iteration - 1, self.facts.count
        self.final_growth = max(
            self.final_growth, int(MOMENTUM * self.final_growth + min(MOST_ADDED, above)))
        growth = self.final_growth
        if o.max_gaussians:
            growth = min(growth, o.max_gaussians - initial)
        if steps + o.densify_every < o.densify_until:
            growth /= self.factor ** (2 - steps / o.densify_until)
        return max(count, min(initial + int(growth), count + count // MOST_GROWTH))

    def ahead(self, iteration):
        """See `Schedule.ahead`: along the curve."""
        left = self.options.iterations - iteration
        places = iteration + left * (np.arange(AHEAD) + 0.5) / AHEAD
        return [(float(max(1, self._factor(place))), left / AHEAD) for place in places]

    def state(self):
        return {"factor": self.factor, "decay_began": self.decay_began,
                "final_growth": self.final_growth}

    def load(self, state):
        self.factor, self.decay_began = state["factor"], state["decay_began"]
        self.final_growth = state["final_growth"]


def resolution_curve(facts):
    """(times, sharpness), each float64[32] or of one element: when, as a share of the steps until
    `densify_until`, 1 / factor^2 shall be so much; it is linear in between and ends at 1.

    The largest factor is that at which the photos' spectra hold a quarter of their sum, the
    smallest one of all photos, at most 8. What the mean spectrum gains from there to its whole is
    divided evenly; a share of the gain is reached when its logarithm is.
    """
    grid = np.arange(BINS + 1) / BINS  # 1 / factor
    total = np.zeros(BINS + 1)
    start = 1 / max(1, min(LARGEST_FACTOR, min(facts.size) / TILE))
    for photo in facts.photos():
        held = held_spectrum(photo)
        start = max(start, np.interp(START_SHARE * held[-1], held, grid))
        total += held
    first, whole = np.interp(start, grid, total), total[-1]
    if whole - first <= LEAST_GAIN * whole:  # flat photos, or too small for any other factor
        return np.zeros(1), np.ones(1)
    gains = np.linspace(first, whole, STEPS)
    inverse = np.interp(gains, total, grid)
    inverse[0], inverse[-1] = start, 1
    return np.log(gains / first) / np.log(whole / first), inverse**2


def held_spectrum(photo):
    """float64[1025]: the sum of |spectrum| of a photo uint8[3, H, W] within the centred window that
    is k / 1024 as wide and as high as the whole, for each k."""
    _, height, width = photo.shape
    across, down = np.fft.rfftfreq(width), np.abs(np.fft.fftfreq(height))
    bins = np.ceil(2 * BINS * np.maximum(across, down[:, None])).astype(np.int64).ravel()
    # the transform leaves out the mirror image of all columns but those that are their own
    twice = np.where((across > 0) & (across < 0.5), 2.0, 1.0)
    sums = np.zeros(BINS + 1)
    for channel in photo:  # one at a time: a spectrum is eight times the size of its photo
        spectrum = np.abs(np.fft.rfft2(channel.astype(np.float32))) * twice
        sums += np.bincount(bins, spectrum.ravel(), BINS + 1)
    return np.cumsum(sums)
