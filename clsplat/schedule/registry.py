"""Schedules by name: our own, and those that other packages register as entry points."""

from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from importlib.metadata import EntryPoint, entry_points

from clsplat.config.option import option
from clsplat.errors import InputError
from clsplat.schedule.plan import Schedule

GROUP = "clsplat.schedules"  # of entry points: NAME = MODULE:SUBCLASS_OF_SCHEDULE
OURS = {name: EntryPoint(name, f"clsplat.schedule.{name}:{name.title()}", GROUP)
        for name in ("sig", "constant", "dash", "taming", "mcmc")}


@cache  # reading what every installed package registers takes 15 ms
def others() -> dict[str, EntryPoint]:
    """The schedules that other packages of this environment register."""
    return {entry.name: entry for entry in sorted(entry_points(group=GROUP))
            if entry.name not in OURS}


def schedule_of(name: str) -> type[Schedule]:
    """The class of a schedule; InputError if no package registers it, or it does not load."""
    entry = OURS.get(name) or others().get(name)
    if entry is None:
        raise InputError(f"{name}: no package registers it in {GROUP}; install the one that does "
                         "in this environment")
    try:
        schedule = entry.load()
    except Exception as error:  # noqa: BLE001  (whatever the code of others raises)
        raise InputError(f"{name}: {entry.value} does not load ({type(error).__name__}: {error}); "
                         "correct the package that registers it") from error
    if not (isinstance(schedule, type) and issubclass(schedule, Schedule)):
        raise InputError(f"{name}: what is registered by this name is not a subclass of "
                         "clsplat.Schedule; correct the package that registers it")
    return schedule


def others_that_load() -> dict[str, type[Schedule]]:
    """The classes of `others`, without those that do not load."""
    loaded = {}
    for name in others():
        with suppress(InputError):  # `schedule_of` reports it when the schedule is used
            loaded[name] = schedule_of(name)
    return loaded


@dataclass(frozen=True)
class ScheduleOptions:
    """The schedule that a training follows; its own options are in its file."""

    schedule: str = option("sig", "Schedule", "how resolution and growth are decided: sig follows "
                           "the scene frequency; constant is 3DGS; dash is DashGaussian; taming is "
                           "Taming 3DGS; mcmc is 3DGS-MCMC", main=True, choices=tuple(OURS),
                           more=others)
