"""Schedules by name: our own, and those that other packages register as entry points."""

from functools import cache
from importlib.metadata import EntryPoint

from clsplat.config.plug_in import Group
from clsplat.errors import InputError
from clsplat.schedule.plan import Schedule

GROUP = "clsplat.schedules"  # of entry points: NAME = MODULE:SUBCLASS_OF_SCHEDULE
OURS = {name: EntryPoint(name, f"clsplat.schedule.{name}:{name.title()}", GROUP)
        for name in ("sig", "constant", "dash", "taming", "mcmc")}
REGISTERED = Group(GROUP, OURS)


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
    if name in OURS:
        ours: type[Schedule] = OURS[name].load()
        return ours
    return REGISTERED.load(name, Schedule)
