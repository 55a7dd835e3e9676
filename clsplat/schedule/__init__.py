"""Schedules decide, before each step, the resolution, the degree and whether the model may grow.

Each is a `plan.Schedule`, pure numpy. `sig` follows the scene's frequency, `constant` is 3DGS's,
`dash` and `taming` are the baselines of the SIG paper.
"""

from clsplat.schedule.constant import Constant
from clsplat.schedule.dash import Dash
from clsplat.schedule.plan import Plan, Subject, laid_over, scaled_steps
from clsplat.schedule.sig import Sig
from clsplat.schedule.taming import Taming

SCHEDULES = {"sig": Sig, "constant": Constant, "dash": Dash, "taming": Taming}

__all__ = ["SCHEDULES", "Plan", "Subject", "laid_over", "scaled_steps"]
