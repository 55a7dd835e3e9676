"""What other packages add to clsplat, by entry points of Python packaging."""

from importlib.metadata import EntryPoint, entry_points

from clsplat.errors import InputError

SCHEDULES = "clsplat.schedules"  # group of entry points: NAME = MODULE:SUBCLASS_OF_SCHEDULE


def names(group: str) -> tuple[str, ...]:
    """The names that packages of this environment register in a group."""
    return tuple(sorted(_registered(group)))


def load(group: str, name: str) -> object:
    """What a package registers by a name; InputError where there is none, or it does not load."""
    registered = _registered(group)
    if name not in registered:
        raise InputError(f"{name}: no package registers it in {group}; install the one that does "
                         "in this environment")
    try:
        return registered[name].load()
    except Exception as error:  # noqa: BLE001  (whatever the code of others raises)
        raise InputError(f"{name}: {registered[name].value} does not load ({type(error).__name__}: "
                         f"{error}); correct the package that registers it") from error


def _registered(group: str) -> dict[str, EntryPoint]:
    return {entry.name: entry for entry in entry_points(group=group)}
