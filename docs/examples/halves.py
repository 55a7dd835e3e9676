"""A schedule of one's own: photos of half the size in the first half of the training.

With these lines in the setup.cfg of a package that holds this file, and the package installed,
`clsplat train SCENE --schedule halves -o RUN` takes it, and so does `schedule="halves"` in Python:

    [options.entry_points]
    clsplat.schedules =
        halves = halves:Halves
"""

from clsplat import Plan, Schedule


class Halves(Schedule):
    """Two levels, and rounds of growth in the middle half of the run."""

    levels = (2.0, 1.0)
    defaults = {"exposure": "off", "opacity_rate": 0.05}

    def plan(self, iteration):
        """The Plan of a step, counted from 1."""
        options, share = self.options, iteration / self.options.iterations
        growing = 0.25 < share < 0.75
        return Plan(level=2.0 if share <= 0.5 else 1.0, degree=self.degree(iteration),
                    gathers=growing, grows=growing and iteration % options.densify_every == 0,
                    resets_opacity=False, prunes_large=False, decay=self.decay(iteration))
