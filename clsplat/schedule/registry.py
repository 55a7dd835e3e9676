"""Schedules by name: our own, and those that other packages register as entry points."""

import dataclasses
from functools import cache
from importlib.metadata import EntryPoint, entry_points

from clsplat.config.option import options_of
from clsplat.errors import InputError
from clsplat.schedule.plan import Schedule
from clsplat.schedule.plug_in import CORRECT, clean, guarded, load, source_of

GROUP = "clsplat.schedules"  # of entry points: NAME = MODULE:SUBCLASS_OF_SCHEDULE
OURS = {name: EntryPoint(name, f"clsplat.schedule.{name}:{name.title()}", GROUP)
        for name in ("sig", "constant", "dash", "taming", "mcmc")}


@cache  # reading what every installed package registers takes 15 ms
def others() -> dict[str, EntryPoint]:
    """The schedules that other packages of this environment register."""
    return {entry.name: entry for entry in sorted(entry_points(group=GROUP))
            if entry.name not in OURS}


def offered(schedule: type[Schedule]) -> str:
    """The name under which a class that no package registers is known in this process.

    Parameters
    ----------
    schedule : a class of a module; its name in small letters becomes that of the schedule.
    """
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
        schedule: type[Schedule] = OURS[name].load()
        return schedule
    if name not in others():
        raise InputError(f"{name}: no package registers it in {GROUP}; install the one that does "
                         "in this environment")
    entry = others()[name]
    return guarded(load(entry), name, source_of(entry))


def own_options(name: str, taken: type) -> type | None:
    """The dataclass of a schedule's own options, or None.

    InputError if it is no frozen dataclass of options, or if `taken` has an option of that name.
    """
    own = schedule_of(name).Options
    if own is None:
        return None
    cure = f"{name}: Options of {source_of(others()[name])}"
    try:
        names = [option.name for option in options_of(own)]
        twice = [option for option in names if hasattr(taken, option)]
        dataclasses.make_dataclass("Options", [], bases=(own, taken), frozen=True)
    except (TypeError, AttributeError) as error:
        raise InputError(f"{cure} is not a frozen dataclass of options ({clean(str(error))}); "
                         f"{CORRECT}") from error
    if twice:
        raise InputError(f"{cure} names {', '.join(twice)}, which clsplat has; {CORRECT}")
    return own
