"""A growth rule in a package of your own: of the gaussians that 3DGS would grow, a random half.

It is registered as docs/examples/halves.py describes:

    [options.entry_points]
    clsplat.schedules =
        random-growth = random_growth:RandomGrowth

`grow` is called in each round of growth. It is given what is known of each gaussian (`gradient`,
`prunes`, `rows`, `scores`), and returns what becomes of them by `round.densify` or
`round.relocate`. `round.rng` draws the same numbers when a training is resumed.
"""

from clsplat import Plan, Schedule


class RandomGrowth(Schedule):
    """Full resolution throughout; rounds of growth in the first half of the run."""

    defaults = {"exposure": "off", "opacity_rate": 0.05, "average": 0.0}

    def plan(self, iteration: int) -> Plan:
        """Decide one step, counted from 1."""
        options = self.options
        growing = iteration < options.densify_until
        return Plan(
            level=1.0,
            degree=self.degree(iteration),
            gathers=growing,
            grows=growing and iteration % options.densify_every == 0,
            resets_opacity=False,
            prunes_large=False,
            decay=self.decay(iteration),
        )

    def grow(self, round):
        """Clone or split each of the candidates with a probability of a half."""
        candidates = round.above_threshold()
        return round.densify(candidates & (round.rng.random(len(candidates)) < 0.5))
