"""The schedule of 3DGS-MCMC (Kheradmand et al. 2024): training as sampling, to a fixed number.

Instead of being cloned, split and pruned by thresholds, gaussians that have become transparent are
relocated to where others are, and the model grows by a fixed share in each round
(densify/grow.py). Positions take random steps (cl/noise.cl), and opacities and sizes are
regularised (cl/regularise.cl), so that gaussians that nothing needs become transparent.

Unlike in the authors' code, the initial gaussians are those of the other schedules, and a step
regularises the gaussians that its view sees.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING

from clsplat.config.option import option
from clsplat.schedule.plan import Plan, SceneFacts, Schedule

if TYPE_CHECKING:
    from clsplat.densify.grow import Growth
    from clsplat.densify.round import Round
    from clsplat.options import ScheduledOptions

GROWS_SHARE = 25 / 30  # of the run
CAP = 1_000_000  # gaussians up to which the model grows, unless --max-gaussians names them


@dataclass(frozen=True)
class McmcOptions:
    """Options of the `mcmc` schedule."""

    mcmc_growth: float = option(
        0.05,
        "Growth",
        "growth of the model in a round, as a share of its gaussians",
        minimum=0.0,
        most=10.0,
        part="mcmc",
        flag=False,
    )


class Mcmc(Schedule):
    """Full resolution throughout; rounds of relocation and growth at fixed intervals."""

    defaults = {"exposure": "off", "opacity_rate": 0.05, "average": 0.0, "position_noise": 5e5, "scale_weight": 0.01}
    parts = frozenset({"mcmc"})
    Options = McmcOptions
    fills_target = True

    @classmethod
    def grows_until(cls, options: "ScheduledOptions") -> int:
        return int(GROWS_SHARE * options.iterations)

    @classmethod
    def planned_limit(cls, options: "ScheduledOptions", facts: SceneFacts) -> tuple[int, str]:
        cap = options.max_gaussians or CAP
        return cap, f"{cap:,}: " + ("requested" if options.max_gaussians else "of 3DGS-MCMC")

    def plan(self, iteration: int) -> Plan:
        """See `Schedule.plan`; as in `constant`, rounds follow the step after a round number."""
        o, before = self.options, iteration - 1
        return Plan(
            level=1.0,
            degree=self.degree(iteration),
            gathers=False,
            grows=o.densify_from < before < o.densify_until and before % o.densify_every == 0,
            resets_opacity=False,
            prunes_large=False,
            decay=self.decay(iteration),
        )

    def target(self, iteration: int, count: int, above: int) -> int:
        cap = self.options.max_gaussians or CAP
        return max(count, min(cap, int((1 + self.options.mcmc_growth) * count)))

    def grow(self, round: "Round") -> "Growth":
        """See `Schedule.grow`; in place of pruning, dead gaussians become copies of others."""
        count = int((~round.frozen).sum())
        return round.relocate(round.room(self.target(round.iteration, count, 0), count) or 0)
