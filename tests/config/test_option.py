"""What an option is declared with."""

import sys
import types

from clsplat.config.option import check_flag, kind_of, options_of, parsed

MODULE = """
{future}
from dataclasses import dataclass

from clsplat.config.option import AUTO, option


@dataclass(frozen=True)
class Options:
    share: float = option(0.5, "Halves", "a share", minimum=0.0, maximum=1.0)
    sizes: tuple[int, ...] = option((), "Halves", "sizes", minimum=1)
    limit: int | None = option(None, "Halves", "a limit", words={{AUTO: None}}, minimum=1)
"""


def declared(future, monkeypatch):
    """The options of a module of another package."""
    module = types.ModuleType("halves_of_another_package")
    monkeypatch.setitem(sys.modules, module.__name__, module)
    exec(MODULE.format(future=future), module.__dict__)
    return options_of(module.Options)


def test_types_may_be_given_by_name(monkeypatch):
    plain = declared("", monkeypatch)
    named = declared("from __future__ import annotations", monkeypatch)
    assert [kind_of(option) for option in plain] == [(float, 0), (int, None), (int, 0)]
    assert [kind_of(option) for option in named] == [kind_of(option) for option in plain]
    share, sizes, limit = named
    assert check_flag(sizes, parsed(sizes, "3,4")) == (3, 4)
    assert check_flag(limit, parsed(limit, "auto")) is None
    assert check_flag(share, parsed(share, "0.25")) == 0.25
