"""Code of other packages, found by entry points: loaded only if it is asked for by name; what it
raises is reported as theirs, in one line."""

from __future__ import annotations

import dataclasses
import logging
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from functools import cached_property
from importlib.metadata import EntryPoint, entry_points
from typing import Any

from clsplat.config.option import options_of
from clsplat.errors import ClsplatError, InputError, StopTraining

NOTE_AFTER = 5.0  # seconds of loading
LONGEST = 200  # characters of a text that a message repeats
CORRECT = "correct the package that registers it"
LOG = logging.getLogger(__name__)


class Group:
    """What the packages of this environment register in a group of entry points, NAME =
    MODULE:CLASS.

    Messages call a class `noun`, and its base class `base`; names of `ours` cannot be taken.
    """

    def __init__(self, name: str, noun: str, base: str, ours: Iterable[str] = ()) -> None:
        self.name, self.noun, self.base, self._ours = name, noun, base, frozenset(ours)

    @cached_property  # reading what every installed package registers takes 15 ms
    def others(self) -> dict[str, EntryPoint]:
        """The entries of other packages, by name."""
        return {entry.name: entry for entry in sorted(entry_points(group=self.name))
                if entry.name not in self._ours}

    def source(self, name: str) -> str:
        """Where an entry leads, for messages: module:class, and the package that registers it."""
        entry = self.others[name]
        return f"{entry.value} (package {entry.dist.name if entry.dist else 'unknown'})"

    def load(self, name: str) -> type:
        """Import a class, which may take a while; InputError if it raises, or is no class.

        What a module may raise includes SystemExit, as a script without a main guard does.
        """
        if name not in self.others:
            raise InputError(f"{name}: no package registers it in {self.name}; install the one "
                             "that does in this environment")
        source = self.source(name)
        try:
            with _note_after(f"loading {self.noun} {name!r}: {source} ..."):
                found = self.others[name].load()
        except KeyboardInterrupt:
            raise KeyboardInterrupt(f"while {self.noun} {name!r} was loaded: {source}") from None
        except BaseException as error:
            raise InputError(f"{name}: {source} does not load ({_cause(error)}); {CORRECT}"
                             ) from error
        if not isinstance(found, type):
            self.refuse_base(name)
        loaded: type = found
        return loaded

    def refuse_base(self, name: str) -> None:
        """Raise InputError for what is not of the base class."""
        raise InputError(f"{name}: {self.source(name)} is not a subclass of {self.base}; {CORRECT}")

    def own_options(self, name: str, own: Any, taken: type) -> type | None:
        """The dataclass `own` of an entry's own options, or None.

        InputError if it is no frozen dataclass of options, or has a name that `taken` has.
        """
        if own is None:
            return None
        cure = f"{name}: Options of {self.source(name)}"
        try:
            names = [option.name for option in options_of(own)]
            twice = [option for option in names if hasattr(taken, option)]
            dataclasses.make_dataclass("Options", [], bases=(own, taken), frozen=True)
        except (TypeError, AttributeError) as error:
            raise InputError(f"{cure} is not a frozen dataclass of options ({clean(str(error))}); "
                             f"{CORRECT}") from error
        if twice:
            raise InputError(f"{cure} names {', '.join(twice)}, which clsplat has; {CORRECT}")
        found: type = own
        return found


def guarded(kind: type, methods: Iterable[str], label: str, source: str,
            check: Callable[[str, Any], None] = lambda method, result: None) -> type:
    """A subclass whose methods name it, by the flag `label` and its `Group.source`, in what they
    raise.

    `check` is called with a method and what it returned; it may raise InputError.
    """
    def of(method: str) -> Callable[..., Any]:
        def call(self: Any, *args: Any, **kwargs: Any) -> Any:
            try:
                result = getattr(super(named, self), method)(*args, **kwargs)
            except (ClsplatError, StopTraining):
                raise
            except (Exception, SystemExit) as error:
                raise InputError(f"{label}: {method} of {source} failed ({_cause(error)}); "
                                 f"{CORRECT}") from error
            check(method, result)
            return result
        return call

    named: type = type(kind.__name__, (kind,), {
        method: classmethod(of(method)) if isinstance(_static(kind, method), classmethod)
        else of(method) for method in methods})
    return named


def _static(kind: type, method: str) -> Any:
    """A method as its class has it, not bound."""
    return next(vars(base)[method] for base in kind.__mro__ if method in vars(base))


def overridden(kind: type, base: type) -> list[str]:
    """The methods of a base class that a subclass overrides."""
    return [name for name, value in vars(base).items() if not name.startswith("__")
            and (callable(value) or isinstance(value, classmethod))
            and _static(kind, name) is not value]


def clean(text: str) -> str:
    """A text as the beginning of a single line."""
    return " ".join(text.split())[:LONGEST]


def _cause(error: BaseException) -> str:
    try:
        text = clean(str(error))
    except Exception:  # noqa: BLE001  (also printing it is code of others)
        text = ""
    return f"{type(error).__name__}: {text}" if text else type(error).__name__


@contextmanager
def _note_after(text: str) -> Iterator[None]:
    """Log a text if the block takes longer than NOTE_AFTER."""
    timer = threading.Timer(NOTE_AFTER, LOG.warning, (text,))
    timer.daemon = True
    timer.start()
    try:
        yield
    finally:
        timer.cancel()
