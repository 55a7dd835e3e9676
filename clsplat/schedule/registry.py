"""Schedules by name: our own, and those that other packages register as entry points."""

from __future__ import annotations

from functools import cache
from importlib import import_module
from typing import TYPE_CHECKING

from clsplat.config.plug_in import Group
from clsplat.errors import InputError
from clsplat.schedule.plan import Schedule

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint

GROUP = "clsplat.schedules"  # of entry points: NAME = MODULE:SUBCLASS_OF_SCHEDULE
OURS = {name: f"clsplat.schedule.{name}:{name.title()}" for name in ("sig", "constant", "dash", "taming", "mcmc")}
REGISTERED = Group(GROUP, OURS)


def others() -> dict[str, EntryPoint]:
    """The schedules that other packages of this environment register."""
    return REGISTERED.others


def offered(schedule: type[Schedule]) -> str:
    """The name, its own in small letters, by which this process finds a class that nobody
    registers."""
    name, place = schedule.__name__.lower(), f"{schedule.__module__}:{schedule.__qualname__}"
    known = others().get(name)
    taken = OURS.get(name) or (known.value if known and known.dist else None)
    if taken is None:
        from importlib.metadata import EntryPoint

        others()[name] = EntryPoint(name, place, GROUP)
        schedule_of.cache_clear()
    elif taken != place:
        raise InputError(f"{name}: is the name of another schedule, {taken}; give the class another name")
    return name


@cache
def schedule_of(name: str) -> type[Schedule]:
    """The class of a schedule, which is imported here, and nowhere before it is asked for.

    InputError if no package registers it, or it does not load.
    """
    if name in OURS:
        module, _, own = OURS[name].partition(":")
        ours: type[Schedule] = getattr(import_module(module), own)
        return ours
    return REGISTERED.load(name, Schedule)
