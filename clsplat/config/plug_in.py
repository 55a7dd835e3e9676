"""Classes of other packages, found by entry points, and loaded only if they are asked for."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from functools import cached_property
from typing import TYPE_CHECKING, Any, TypeVar

from clsplat.config.option import options_of
from clsplat.errors import InputError

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint

LONGEST = 200  # characters of a text that a message repeats
CORRECT = "correct the package that registers it"
Base = TypeVar("Base")


class Group:
    """What the packages of this environment register in a group of entry points, NAME =
    MODULE:CLASS; names of `ours` cannot be taken."""

    def __init__(self, name: str, ours: Iterable[str] = ()) -> None:
        self.name, self._ours = name, frozenset(ours)

    @cached_property  # reading what every installed package registers takes 15 ms
    def others(self) -> dict[str, EntryPoint]:
        """The entries of other packages, by name."""
        from importlib.metadata import entry_points  # a fifth of what `clsplat --help` imports

        return {entry.name: entry for entry in sorted(entry_points(group=self.name)) if entry.name not in self._ours}

    def load(self, name: str, base: type[Base] | None = None) -> type[Base]:
        """Import a class; InputError if it does not load, or is no subclass of `base`."""
        if name not in self.others:
            raise InputError(
                f"{name}: no package registers it in {self.name}; install the one that does in this environment"
            )
        try:
            found: type[Base] = self.others[name].load()
        except (Exception, SystemExit) as error:  # a script without a main guard exits
            cause = " ".join(str(error).split())[:LONGEST]
            raise InputError(
                f"{self._source(name)} does not load ({type(error).__name__}: {cause}); {CORRECT}"
            ) from error
        if not isinstance(found, type) or base and not issubclass(found, base):
            raise InputError(
                f"{self._source(name)} is not a subclass of clsplat.{base.__name__ if base else 'Part'}; {CORRECT}"
            )
        return found

    def own_options(self, name: str, own: Any, taken: type) -> type | None:
        """The frozen dataclass `own` of an entry's own options, or None; InputError if it is no
        such class, or has a name that `taken` has."""
        if own is None:
            return None
        if not (dataclasses.is_dataclass(own) and isinstance(own, type) and own.__dataclass_params__.frozen):  # type: ignore[attr-defined]
            raise InputError(f"Options of {self._source(name)} is not a frozen dataclass of options; {CORRECT}")
        if twice := [option.name for option in options_of(own) if hasattr(taken, option.name)]:
            raise InputError(f"Options of {self._source(name)} names {', '.join(twice)}, which clsplat has; {CORRECT}")
        return own

    def _source(self, name: str) -> str:
        """Where an entry leads: its name, module and class, and the package that registers it."""
        entry = self.others[name]
        return f"{name}: {entry.value} (package {entry.dist.name if entry.dist else 'unknown'})"
