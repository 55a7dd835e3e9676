"""Schedules decide, before each step, the resolution, the degree and whether the model may grow.

A schedule has one method, `plan(iteration) -> Plan`, and is pure numpy. `constant` is that of
3DGS: full resolution throughout, growth at fixed intervals.
"""

from clsplat.schedule.constant import Constant
from clsplat.schedule.plan import Plan, scaled_steps

SCHEDULES = {"constant": Constant}

__all__ = ["SCHEDULES", "Plan", "scaled_steps"]
