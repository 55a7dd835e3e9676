"""The flags of commands, derived from dataclasses of options."""

import math

import click
from click.core import ParameterSource

from clsplat.cli.sections import SectionedOption
from clsplat.config.option import check_flag, expected, flag_name, kind_of, options_of, parsed
from clsplat.errors import InputError
from clsplat.options import TrainOptions

DEVICE = "CLSPLAT_DEVICE"  # environment variable: the device of a worker
NAMES = {int: "INTEGER", float: "FLOAT", str: "TEXT"}


class GivenPath(click.Path):
    """A path that is not empty: "" would be the current folder."""

    def convert(self, value, param, ctx):
        if str(value) == "":
            self.fail("is empty; give a path, or . for the current folder", param, ctx)
        return super().convert(value, param, ctx)


class FiniteRange(click.FloatRange):
    """A finite number within limits, which `nan` would slip through."""

    def convert(self, value, param, ctx):
        number = super().convert(value, param, ctx)
        if not math.isfinite(number):
            self.fail(f"{value} is not a finite number", param, ctx)
        return number


class Value(click.ParamType):
    """A value of an option as its text says it, or one of the option's words."""

    def __init__(self, option):
        self.option, self.choices = option, option.metadata["choices"]
        kind, count = kind_of(option)
        self.name = ("LIST" if count is None else
                     option.metadata["separator"].join("NM") if count else NAMES[kind])

    def get_metavar(self, param, ctx):
        shown = (*self.option.metadata["words"], *(self.choices or (self.name,)))
        return f"[{'|'.join(shown)}]" if len(shown) > 1 else self.name

    def shell_complete(self, ctx, param, incomplete):
        return [click.shell_completion.CompletionItem(word)
                for word in (*self.option.metadata["words"], *self.choices)
                if word.startswith(incomplete)]

    def convert(self, value, param, ctx):
        if not isinstance(value, str):
            return value
        try:
            return parsed(self.option, value)
        except ValueError:
            raise InputError(f"{flag_name(self.option.name)} {value}: expects "
                             f"{expected(self.option)}") from None


def flags_of(kind):
    """Decorator: one flag for each option of a dataclass, in order, under its group's heading."""
    def decorate(command):
        for option in reversed(options_of(kind)):
            command = _flag(option)(command)
        return command
    return decorate


training_flags = flags_of(TrainOptions)


def given_options(ctx, kind=TrainOptions):
    """{option: value} of the flags of a dataclass that the user wrote; defaults are left out."""
    return {option.name: ctx.params[option.name] for option in options_of(kind)
            if ctx.get_parameter_source(option.name) is not ParameterSource.DEFAULT}


def _flag(option):
    meta, default, name = option.metadata, option.default, flag_name(option.name)
    kind, count = kind_of(option)
    word = next((word for word, value in meta["words"].items() if value == default), None)
    settings = {"help": meta["help"], "default": default if word is None else word,
                "show_default": True}
    if kind is bool:
        name = f"{name}/--no-{name[2:]}"
    elif count is None:  # one list, or several that are joined
        settings.update(type=Value(option), multiple=True, default=(), show_default=word)
    elif count and not meta["separator"]:
        settings.update(type=kind, nargs=count, default=default)
    else:
        settings["type"] = Value(option)

    def check(ctx, param, value):
        if ctx.get_parameter_source(param.name) is ParameterSource.DEFAULT:
            return option.default
        return check_flag(option, sum(value, ()) if count is None else value)

    names = [name, option.name] if meta["short"] is None else [meta["short"], name, option.name]
    return click.option(*names, cls=SectionedOption, section=meta["group"], main=meta["main"],
                        callback=check, envvar=DEVICE if option.name == "device" else None,
                        **settings)
