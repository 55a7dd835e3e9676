"""A schedule of one's own: photos of half the size in the first half of the training, or another
share of it.

With these lines in the setup.cfg of a package that holds this file, and the package installed,
`clsplat train SCENE --schedule halves -o RUN` takes it, and so does `schedule="halves"` in Python:

    [options.entry_points]
    clsplat.schedules =
        halves = halves:Halves
"""

from dataclasses import dataclass

from clsplat import Plan, Schedule, option


@dataclass(frozen=True)
class HalvesOptions:
    """Options of this schedule: flags, keys of a TOML file and arguments of `clsplat.train`."""

    half_share: float = option(0.5, "Levels", "share of the run at half size", minimum=0.0,
                               maximum=1.0, part="halves")


class Halves(Schedule):
    """Two levels, and rounds of growth in the middle half of the run."""

    Options = HalvesOptions
    parts = frozenset({"halves", "levels"})
    levels = (2.0, 1.0)
    defaults = {"exposure": "off", "opacity_rate": 0.05}

    def plan(self, iteration):
        """The Plan of a step, counted from 1."""
        options, share = self.options, iteration / self.options.iterations
        growing, level = 0.25 < share < 0.75, 2.0 if share <= options.half_share else 1.0
        return Plan(level=level, degree=self.degree(iteration),
                    gathers=growing, grows=growing and iteration % options.densify_every == 0,
                    resets_opacity=False, prunes_large=False, decay=self.decay(iteration))
