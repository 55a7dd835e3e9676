"""Schedules by name: our own, and those that other packages register as entry points."""

import math
from collections.abc import Callable
from functools import cache
from importlib.metadata import EntryPoint
from typing import Any

from clsplat.config.plug_in import CORRECT, Group, clean, guarded
from clsplat.errors import InputError
from clsplat.schedule.plan import Plan, Schedule

GROUP = "clsplat.schedules"  # of entry points: NAME = MODULE:SUBCLASS_OF_SCHEDULE
OURS = {name: EntryPoint(name, f"clsplat.schedule.{name}:{name.title()}", GROUP)
        for name in ("sig", "constant", "dash", "taming", "mcmc")}
REGISTERED = Group(GROUP, "schedule", "clsplat.Schedule", OURS)
# of a schedule: what each must be, in words and as a function of the value
ATTRIBUTES: dict[str, tuple[str, Callable[[Any], bool]]] = {
    "levels": ("a tuple of numbers of at least 1", lambda levels: isinstance(levels, (tuple, list))
               and bool(levels) and all(isinstance(level, (int, float)) and 1 <= level < math.inf
                                        for level in levels)),
    "parts": ("a frozenset of names", lambda parts: isinstance(parts, (set, frozenset))),
    "defaults": ("a dict", lambda defaults: isinstance(defaults, dict)),
    "observe_every": ("a whole number of at least 1", lambda n: isinstance(n, int) and n > 0)}


def others() -> dict[str, EntryPoint]:
    """The schedules that other packages of this environment register."""
    return REGISTERED.others


def offered(schedule: type[Schedule]) -> str:
    """The name, its own in small letters, by which this process finds a class that nobody
    registers."""
    name, place = schedule.__name__.lower(), f"{schedule.__module__}:{schedule.__qualname__}"
    known = OURS.get(name) or others().get(name)
    if known is None or name not in OURS and known.dist is None:
        others()[name] = EntryPoint(name, place, GROUP)
        schedule_of.cache_clear()
    elif known.value != place:
        raise InputError(f"{name}: is the name of another schedule, {known.value}; give the class "
                         "another name")
    return name


@cache
def schedule_of(name: str) -> type[Schedule]:
    """The class of a schedule, which is imported here, and nowhere before it is asked for.

    InputError if no package registers it, or it does not load.
    """
    schedule: type[Schedule]
    if name in OURS:
        schedule = OURS[name].load()
        return schedule
    loaded = REGISTERED.load(name)
    if not issubclass(loaded, Schedule):
        REGISTERED.refuse_base(name)
    label, source = f"--schedule {name}", REGISTERED.source(name)
    for attribute, (wanted, is_right) in ATTRIBUTES.items():
        value = getattr(loaded, attribute)
        if not (isinstance(value, property) or is_right(value)):
            raise InputError(f"{label}: {attribute} of {source} is {clean(repr(value))}, not "
                             f"{wanted}; {CORRECT}")

    def check(method: str, result: Any) -> None:
        if method == "plan" and not isinstance(result, Plan):
            raise InputError(f"{label}: plan of {source} returned {clean(repr(result))}, not a "
                             f"clsplat.Plan; {CORRECT}")

    methods = [method for method, value in vars(Schedule).items()
               if callable(value) or isinstance(value, classmethod)]
    schedule = guarded(loaded, methods, label, source, check)
    return schedule
