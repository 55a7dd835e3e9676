"""The schedule of Taming 3DGS (Mallick et al. 2024): 3DGS whose growth follows a budget."""

from clsplat.schedule.constant import Constant


class Taming(Constant):
    """Full resolution throughout; the number of gaussians rises to `taming_budget` times the
    initial one, fast at first, along a parabola that is flat at `densify_until`."""

    selection = "score"
    rounds_sparing = 27  # the first ones, which prune only half of what 3DGS would

    def target(self, iteration, count, above):
        o, start = self.options, self.facts.count
        end = o.taming_budget * start
        if o.max_gaussians:
            end = min(end, o.max_gaussians)
        share = (iteration - 1 - o.densify_from) / max(1, o.densify_until - o.densify_from)
        share = min(max(share, 0.0), 1.0)
        return max(count, int(start + (end - start) * (2 * share - share**2)))

    def spares_half(self, iteration):
        return (iteration - 1 - self.options.densify_from) // self.options.densify_every \
            <= self.rounds_sparing
