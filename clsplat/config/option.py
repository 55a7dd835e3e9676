"""An option: a dataclass field with a default, limits and a help text, and how values are read.

Each package declares its options as a frozen dataclass of such fields; `clsplat/options.py`
composes them. The same fields are keys of a TOML file and of a run's record, and some become flags
of the command line (cli/flags.py).
"""

import dataclasses
import json
import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from types import UnionType
from typing import Any, get_args, get_type_hints

from clsplat.errors import InputError

AUTO = "auto"
MOST = {int: 2**63 - 1, float: 1e15}  # squares and their sums stay far within float32
MOST_STEPS = 10_000_000  # in a training: 300 times the default
SHOWN = 200  # characters of a user's value that a message repeats
KINDS = {int: "a whole number", float: "a number", bool: "true or false", str: "a text"}

Option = dataclasses.Field[Any]


def option(
    default: Any,
    group: str,
    text: str,
    *,
    affects: str = "model",
    short: str | None = None,
    main: bool = False,
    words: dict[str, Any] | None = None,
    choices: Sequence[str] = (),
    more: Callable[[], Iterable[str]] | None = None,
    minimum: float | None = None,
    maximum: float | None = None,
    most: float | None = None,
    expects: str | None = None,
    check: Callable[[Any], object] | None = None,
    separator: str | None = None,
    sets: dict[Any, dict[str, Any]] | None = None,
    part: str | None = None,
    flag: bool = True,
    measured: bool = False,
) -> Any:
    """A field of a dataclass of options.

    Parameters
    ----------
    default : the value where nobody gives one.
    group : heading under which the help lists it.
    text : help text.
    affects : "model" (the bytes of the result), "time" (the duration, or other files) or "nothing".
    short : second flag, such as -n.
    main : whether --help lists the option; --help-all lists all of them.
    words : word -> the value that it stands for; the limits do not apply to it.
    choices : the allowed values.
    more : returns choices that other packages add; called only when they are needed.
    minimum, maximum : limits of a number, or of each element of a tuple.
    most : practical upper bound, which messages do not list as a limit; default MOST of the type.
    expects : what an error message says is expected, where limits and type do not say it well.
    check : called with a value within the limits; raises ValueError to refuse it.
    separator : between the elements of a tuple that is a single word on the command line.
    sets : value of this option -> {name: value} of options that it sets unless the user does.
    part : part of a training that the option belongs to; schedules without it refuse the option.
    flag : whether it is a flag of the command line, too; else it is for Python, TOML and presets.
    measured : whether a measurement chose the default; docs/evidence/index.md has a line for it.
    """
    settings = {name: value for name, value in locals().items() if name not in ("default", "text")}
    return dataclasses.field(
        default=default, metadata={**settings, "help": text, "words": words or {}, "sets": sets or {}}
    )


def options_of(kind: type) -> list[Option]:
    """The options among the fields of a dataclass, in order."""
    options = [field for field in dataclasses.fields(kind) if "affects" in field.metadata]
    if any(isinstance(option.type, str) for option in options):
        types = get_type_hints(kind)  # `from __future__ import annotations` leaves their names
        for option in options:
            option.type = types[option.name]
    return options


def is_auto(value: object) -> bool:
    """Whether the value of an option is the word AUTO, which its type may not name."""
    return value == AUTO


def flag_name(name: str) -> str:
    """An option's name as a flag, with hyphens."""
    return "--" + name.replace("_", "-")


def shown_name(option: Option) -> str:
    """How messages name an option: as its flag, or as a key if it is none."""
    return flag_name(option.name) if option.metadata["flag"] else f"option '{option.name}'"


def shown_default(option: Option) -> Any:
    """The default of an option, as the word that stands for it if there is one."""
    return next((word for word, value in option.metadata["words"].items() if value == option.default), option.default)


def kind_of(option: Option) -> tuple[Any, int | None]:
    """(type of a value or of each element, number of elements).

    The number is 0 if the option is not a tuple, and None if a tuple may have any length.
    """
    kind: Any = option.type
    if isinstance(kind, UnionType):  # X | None: a word stands for None
        kind = get_args(kind)[0]
    elements = get_args(kind)
    if not elements:
        return kind, 0
    return elements[0], None if ... in elements else len(elements)


def expected(option: Option) -> str:
    """The values that an option expects, in words, for an error message."""
    meta = option.metadata
    low, high = meta["minimum"], meta["maximum"]
    if meta["expects"]:
        text = meta["expects"]
    elif meta["choices"]:
        text = f"one of {', '.join((*meta['choices'], *(meta['more']() if meta['more'] else ())))}"
    else:
        text = KINDS[kind_of(option)[0]]
        if low is not None:
            text += f" of at least {low:g}" if high is None else f" from {low:g} to {high:g}"
    return f"{', '.join(meta['words'])} or {text}" if meta["words"] else text


def _checked_value(option: Option, value: Any) -> Any:
    """Convert a value to the type of the option, or refuse it by a ValueError that says what is
    expected; one without text means what `expected` returns.

    A word becomes what it stands for, an integer becomes a float where one is expected, and a list,
    as TOML and JSON have it, becomes a tuple.
    """
    words, (kind, count) = option.metadata["words"], kind_of(option)
    if isinstance(value, list):
        value = tuple(value)
    if isinstance(value, str) and value in words:
        return words[value]
    for meaning in words.values():
        if type(value) is type(meaning) and value == meaning:
            return value
    if count == 0:
        value = _checked_one(option, kind, value)
    else:
        if not isinstance(value, tuple) or count not in (None, len(value)):
            raise ValueError
        value = tuple(_checked_one(option, kind, element) for element in value)
    if option.metadata["check"]:
        option.metadata["check"](value)
    return value


def _checked_one(option: Option, kind: Any, value: Any) -> Any:
    meta = option.metadata
    if kind is float and type(value) is int:
        value = float(value) if abs(value) < 2**63 else math.inf
    if (
        type(value) is not kind
        or meta["choices"]
        and not (value in meta["choices"] or meta["more"] and value in meta["more"]())
    ):
        raise ValueError
    if kind is str:
        if "\0" in value or any("\ud800" <= letter <= "\udfff" for letter in value):
            raise ValueError("text in Unicode")  # neither JSON nor a path can contain it
    elif kind is not bool:
        low, high = meta["minimum"], meta["maximum"]
        most = MOST[kind] if meta["most"] is None else meta["most"]
        if (low is not None and not value >= low) or (high is not None and not value <= high):
            raise ValueError
        if kind is float and not math.isfinite(value):
            raise ValueError("a finite number")
        if value > most:
            raise ValueError(f"at most {most:,}" if kind is int else f"at most {most:g}")
    return value


def parsed(option: Option, text: str) -> Any:
    """Parse a text of the command line without checking limits; ValueError for what is no value."""
    kind, count = kind_of(option)
    if text in option.metadata["words"]:
        return option.metadata["words"][text]
    if count == 0:
        return kind(text)
    text = text if kind is str else text.lower()
    return tuple(kind(part) for part in text.split(option.metadata["separator"] or ","))


def check_flag(option: Option, value: Any) -> Any:
    """`_checked_value` of the value of a flag; the InputError names the flag."""
    try:
        return _checked_value(option, value)
    except ValueError as error:
        between = option.metadata["separator"] or (" " if kind_of(option)[1] else ",")
        text = between.join(
            f"{part:g}" if isinstance(part, float) else str(part)
            for part in (value if isinstance(value, tuple) else (value,))
        )
        raise InputError(f"{flag_name(option.name)} {text[:SHOWN]}: expects {str(error) or expected(option)}") from None


def checked(kind: type, source: str, key: str, value: Any) -> Any:
    """The value of the option `key` of a dataclass; InputError, which begins with `source`, for one
    that is not allowed."""
    source = source and f"{source}: "
    option = next((option for option in options_of(kind) if option.name == key), None)
    if option is None:
        raise InputError(f"{source}unknown option {key[:SHOWN]!r}; see `clsplat train --help-all`")
    try:
        return _checked_value(option, value)
    except ValueError as error:
        raise InputError(
            f"{source}option '{key.replace('_', '-')}' expects {str(error) or expected(option)}, got {value!r:.{SHOWN}}"
        ) from None


def plain(value: Any) -> Any:
    """A value, or a dataclass as a dict, as it is after a round trip through JSON."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        value = dataclasses.asdict(value)
    return json.loads(json.dumps(value))


def differences(record: dict[str, Any], options: Any) -> Iterator[tuple[str, Any, Any]]:
    """Yield (name, recorded value, present value) of each option that would make another run.

    This alone decides whether two runs are the same: options that affect "nothing" may differ.
    `record` is option -> value, as a JSON file has it.
    """
    present = plain(options)
    for known in options_of(type(options)):
        # a record of an earlier version lacks later options, whose defaults change nothing
        recorded = plain(record.get(known.name, known.default))
        if known.metadata["affects"] != "nothing" and recorded != present[known.name]:
            yield known.name, recorded, present[known.name]
