"""The schedule of Taming 3DGS (Mallick et al. 2024): 3DGS whose growth follows a budget."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

from clsplat.config.option import option
from clsplat.schedule.constant import Constant
from clsplat.schedule.plan import AS_PUBLISHED, STEPS_A_ROUND

if TYPE_CHECKING:
    from clsplat.densify.grow import Growth
    from clsplat.densify.round import Round
    from clsplat.options import ScheduledOptions

ROUNDS = 60  # of growth in a run: one every 500 of 30,000 steps


@dataclass(frozen=True)
class TamingOptions:
    """Options of the `taming` schedule."""

    taming_budget: float = option(
        15.0,
        "Growth",
        "number of gaussians at the end, as a multiple of those at the start",
        minimum=1.0,
        part="taming",
        flag=False,
    )


class Taming(Constant):
    """Full resolution throughout; the number of gaussians rises to `taming_budget` times the
    initial one, fast at first, along a parabola that is flat at `densify_until`."""

    defaults = {**AS_PUBLISHED, "reset_every": 3000, "prune_size": 0.1}
    parts = frozenset({"taming"})
    Options = TamingOptions
    fills_target = True
    rounds_sparing = 27  # in the first rounds, half of the gaussians that 3DGS prunes stay

    @classmethod
    def grows_every(cls, options: "ScheduledOptions") -> int:
        return max(STEPS_A_ROUND, options.iterations // ROUNDS)

    def target(self, iteration: int, count: int, above: int) -> int:
        o, start = self.options, self.facts.count
        end = o.taming_budget * start
        if o.max_gaussians:
            end = min(end, o.max_gaussians)
        share = (iteration - 1 - o.densify_from) / max(1, o.densify_until - o.densify_from)
        share = min(max(share, 0.0), 1.0)
        return max(count, int(start + (end - start) * (2 * share - share**2)))

    def grow(self, round: "Round") -> "Growth":
        """See `Schedule.grow`; gaussians above the threshold are drawn by their scores."""
        o, prunes = self.options, round.prunes
        if (round.iteration - 1 - o.densify_from) // o.densify_every <= self.rounds_sparing:
            prunes = round.half_of_prunes()
        room = self.room(round, prunes)
        assert room is not None  # there is a target
        return round.densify(round.by_score(room, prunes), prunes)
