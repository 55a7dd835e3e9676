"""Schedules decide, before each step, the resolution, the degree and whether the model may grow.

Each is a `plan.Schedule`, pure numpy. `sig` follows the scene's frequency, `constant` is 3DGS's,
`dash` and `taming` are the baselines of the SIG paper.
"""

from clsplat import extensions
from clsplat.errors import InputError
from clsplat.schedule.constant import Constant
from clsplat.schedule.dash import Dash
from clsplat.schedule.plan import Plan, SceneFacts, Schedule, laid_over, scaled_steps
from clsplat.schedule.sig import Sig
from clsplat.schedule.taming import Taming

SCHEDULES = {"sig": Sig, "constant": Constant, "dash": Dash, "taming": Taming}


def schedule_of(name: str) -> type[Schedule]:
    """The class of a schedule: ours, or what another package registers by that name; InputError
    where there is none."""
    if name in SCHEDULES:
        return SCHEDULES[name]
    found = extensions.load(extensions.SCHEDULES, name)
    if not (isinstance(found, type) and issubclass(found, Schedule)):
        raise InputError(f"{name}: what is registered by this name is not a subclass of "
                         "clsplat.Schedule; correct the package that registers it")
    return found


__all__ = ["SCHEDULES", "Plan", "SceneFacts", "Schedule", "laid_over", "scaled_steps",
           "schedule_of"]
