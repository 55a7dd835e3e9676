"""The schedule of 3DGS (Kerbl et al. 2023): the step number alone decides."""

from clsplat.schedule.plan import AS_PUBLISHED, Plan, Schedule


class Constant(Schedule):
    """Full resolution throughout, growth and opacity resets at fixed intervals."""

    defaults = {**AS_PUBLISHED, "reset_every": 3000, "opacity_rate": 0.05, "prune_size": 0.1}

    def plan(self, iteration: int) -> Plan:
        """See `Schedule.plan`.

        Growth follows the step after a round number: evaluations at round numbers then see a model
        that has had a whole interval to recover.
        """
        o = self.options
        before = iteration - 1
        growing = before < o.densify_until
        return Plan(
            level=1.0,
            degree=self.degree(iteration),
            gathers=growing,
            grows=growing and before > o.densify_from and before % o.densify_every == 0,
            resets_opacity=growing and o.reset_every > 0 and before > 0 and before % o.reset_every == 0,
            prunes_large=0 < o.reset_every < before,
            decay=self.decay(iteration),
        )
