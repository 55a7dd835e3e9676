"""A schedule in a package of your own: photos of half the size in the first half of the training.

Put this file into a package, add these lines to its setup.cfg, and install it. Then
`clsplat train SCENE --schedule halves -o RUN` uses it, and so does `schedule="halves"` in Python:

    [options.entry_points]
    clsplat.schedules =
        halves = halves:Halves
"""

from dataclasses import dataclass

from clsplat import Plan, Schedule, option


@dataclass(frozen=True)
class HalvesOptions:
    """Options of this schedule; they become flags, keys of a TOML file and Python arguments."""

    half_share: float = option(0.5, "Levels", "share of the run at half size", minimum=0.0, maximum=1.0, part="halves")


class Halves(Schedule):
    """Two levels, and rounds of growth in the middle half of the run.

    `Schedule` documents each attribute and method. This one depends on the step number alone;
    one that follows the scene frequency also has `observe`, and `state` and `load` for what it
    remembers.
    """

    Options = HalvesOptions
    parts = frozenset({"halves", "levels"})
    levels = (2.0, 1.0)
    defaults = {"exposure": "off", "opacity_rate": 0.05, "average": 0.0}

    def plan(self, iteration: int) -> Plan:
        """Decide one step, counted from 1."""
        options, share = self.options, iteration / self.options.iterations
        growing, level = 0.25 < share < 0.75, 2.0 if share <= options.half_share else 1.0
        return Plan(
            level=level,
            degree=self.degree(iteration),
            gathers=growing,
            grows=growing and iteration % options.densify_every == 0,
            resets_opacity=False,
            prunes_large=False,
            decay=self.decay(iteration),
        )
