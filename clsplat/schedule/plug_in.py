"""Schedules of other packages: what their code raises is reported as theirs, in one line."""

from __future__ import annotations

import logging
import math
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib.metadata import EntryPoint
from typing import Any

from clsplat.errors import ClsplatError, InputError, StopTraining
from clsplat.schedule.plan import Plan, Schedule

NOTE_AFTER = 5.0  # seconds of loading
LONGEST = 200  # characters of a text that a message repeats
CORRECT = "correct the package that registers it"
SELECTIONS = "threshold", "highest", "score", "relocation"
# of a schedule: what each must be, in words and as a function of the value
ATTRIBUTES: dict[str, tuple[str, Callable[[Any], bool]]] = {
    "levels": ("a tuple of numbers of at least 1", lambda levels: isinstance(levels, (tuple, list))
               and bool(levels) and all(isinstance(level, (int, float)) and 1 <= level < math.inf
                                        for level in levels)),
    "parts": ("a frozenset of names", lambda parts: isinstance(parts, (set, frozenset))),
    "defaults": ("a dict", lambda defaults: isinstance(defaults, dict)),
    "selection": (f"one of {', '.join(SELECTIONS)}", lambda name: name in SELECTIONS),
    "observe_every": ("a whole number of at least 1", lambda n: isinstance(n, int) and n > 0)}
LOG = logging.getLogger(__name__)


def source_of(entry: EntryPoint) -> str:
    """Where an entry point leads, for messages: module:class, and the package that registers it."""
    return f"{entry.value} (package {entry.dist.name if entry.dist else 'unknown'})"


def clean(text: str) -> str:
    """A text as the beginning of a single line."""
    return " ".join(text.split())[:LONGEST]


def load(entry: EntryPoint) -> type[Schedule]:
    """Import the schedule of another package; InputError if it raises, or is no schedule.

    What a module may raise includes SystemExit, as a script without a main guard does.
    """
    source = source_of(entry)
    try:
        with _note_after(f"loading schedule {entry.name!r}: {source} ..."):
            schedule = entry.load()
    except KeyboardInterrupt:
        raise KeyboardInterrupt(f"while schedule {entry.name!r} was loaded: {source}") from None
    except BaseException as error:
        raise InputError(f"{entry.name}: {source} does not load ({_cause(error)}); {CORRECT}"
                         ) from error
    if not (isinstance(schedule, type) and issubclass(schedule, Schedule)):
        raise InputError(f"{entry.name}: {source} is not a subclass of clsplat.Schedule; {CORRECT}")
    return schedule


def guarded(schedule: type[Schedule], name: str, source: str) -> type[Schedule]:
    """A subclass of a schedule whose methods name the schedule in what they raise.

    Parameters
    ----------
    schedule : of another package.
    name : as users give it.
    source : the result of `source_of`.
    """
    for attribute, (wanted, is_right) in ATTRIBUTES.items():
        value = getattr(schedule, attribute)
        if not (isinstance(value, property) or is_right(value)):
            raise InputError(f"--schedule {name}: {attribute} of {source} is {clean(repr(value))}, "
                             f"not {wanted}; {CORRECT}")

    def of(method: str) -> Callable[..., Any]:
        def call(self: Any, *args: Any, **kwargs: Any) -> Any:
            try:
                result = getattr(super(kind, self), method)(*args, **kwargs)
            except (ClsplatError, StopTraining):
                raise
            except (Exception, SystemExit) as error:
                raise InputError(f"--schedule {name}: {method} of {source} failed "
                                 f"({_cause(error)}); {CORRECT}") from error
            if method == "plan" and not isinstance(result, Plan):
                raise InputError(f"--schedule {name}: plan of {source} returned "
                                 f"{clean(repr(result))}, not a clsplat.Plan; {CORRECT}")
            return result
        return call

    methods = {method: classmethod(of(method)) if isinstance(value, classmethod) else of(method)
               for method, value in vars(Schedule).items()
               if callable(value) or isinstance(value, classmethod)}
    kind: type[Schedule] = type(schedule.__name__, (schedule,), methods)
    return kind


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
