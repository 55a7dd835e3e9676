"""The flags of `clsplat train`, derived from the table of options."""

import dataclasses
import math
from typing import get_args

import click
from click.core import ParameterSource

from clsplat import extensions
from clsplat.cli.sections import SectionedOption
from clsplat.options import AUTO, TrainOptions

# what most users choose; --help-all lists the others
MAIN = {"iterations", "time_budget", "seed", "eval_every", "downscale", "max_resolution", "images",
        "test_every", "init", "schedule", "preset", "exposure", "sh_degree", "max_gaussians",
        "device"}
DEVICE = "CLSPLAT_DEVICE"  # environment variable: the device of a worker


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


class Numbers(click.ParamType):
    """Numbers of one kind, separated by commas."""

    name = "LIST"

    def __init__(self, kind):
        self.kind = kind

    def convert(self, value, param, ctx):
        try:
            return tuple(self.kind(word) for word in value.split(","))
        except ValueError:
            self.fail(f"{value!r} is not a list of numbers such as 4,2,1", param, ctx)


class NumberOrAuto(click.ParamType):
    """A number of one kind, or `auto`."""

    def __init__(self, kind):
        self.kind, self.name = kind, f"{kind.__name__}|auto"

    def convert(self, value, param, ctx):
        if value == AUTO:
            return value
        try:
            return self.kind(value)
        except ValueError:
            self.fail(f"{value!r} is neither auto nor a number.", param, ctx)


class ExtensibleChoice(click.Choice):
    """A choice to which other packages add by entry points, which are asked only if need be."""

    def __init__(self, choices, group):
        super().__init__(choices)
        self.group = group

    def convert(self, value, param, ctx):
        if value not in self.choices and value in extensions.names(self.group):
            return value
        return super().convert(value, param, ctx)


def training_flags(command):
    """Decorator: one flag for each field of TrainOptions, in order, under its group's heading."""
    for option in reversed(dataclasses.fields(TrainOptions)):
        command = _flag(option)(command)
    return command


def given_options(ctx):
    """{option: value} of the training flags that the user wrote; defaults are left out."""
    return {option.name: ctx.params[option.name] for option in dataclasses.fields(TrainOptions)
            if ctx.get_parameter_source(option.name) is not ParameterSource.DEFAULT}


def flag_name(name):
    """An option's name as a flag, with hyphens."""
    return "--" + name.replace("_", "-")


def _flag(option):
    meta, default, name = option.metadata, option.default, flag_name(option.name)
    settings = {"help": meta["help"], "default": default,
                "show_default": default != ""}
    if isinstance(default, bool):
        name = f"{name}/--no-{name[2:]}"
    elif meta["extensions"]:
        settings["type"] = ExtensibleChoice(meta["choices"], meta["extensions"])
    elif meta["choices"]:
        settings["type"] = click.Choice(meta["choices"])
    elif default == ():
        settings.update(type=Numbers(get_args(option.type)[0]), multiple=True, show_default=False,
                        callback=lambda ctx, param, lists: sum(lists, ()))
    elif meta["auto"]:
        settings["type"] = NumberOrAuto(option.type)
    elif isinstance(default, tuple):
        settings.update(type=type(default[0]), nargs=len(default))
    else:
        settings["type"] = type(default)
    if option.name == "device":
        settings["envvar"] = DEVICE
    names = [name, option.name] if meta["short"] is None else [meta["short"], name, option.name]
    return click.option(*names, cls=SectionedOption, section=meta["group"],
                        main=option.name in MAIN, **settings)
