"""The flags of commands, derived from dataclasses of options, and help texts in sections."""

import math
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import click
from click.core import ParameterSource

from clsplat.config import option as declared
from clsplat.config.option import Option, options_of, shown_default
from clsplat.errors import InputError
from clsplat.options import TrainOptions, from_toml, options_with
from clsplat.schedule.registry import OURS, others

SHOW_ALL = "clsplat.help_all"  # in a context's `meta` if its help lists every option
DEVICE = "CLSPLAT_DEVICE"  # environment variable: the device of a worker
# in a context's `meta`: the dataclass of options, and the options that the file of --config gives
OPTIONS, CONFIG = "clsplat.options", "clsplat.config"
OTHER_FLAGS = "clsplat.other_flags"  # and the flags of schedules and parts of other packages
NAMES = {int: "INTEGER", float: "FLOAT", str: "TEXT"}
Command = TypeVar("Command", bound=Callable[..., Any])


class SectionedOption(click.Option):
    """An option that the help lists under the heading `section`.

    Unless it is `main`, only --help-all lists it.
    """

    def __init__(self, *args: Any, section: str, main: bool = True, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.section, self.main = section, main


class SectionedCommand(click.Command):
    """A command whose help has a section for each heading of its options.

    --help lists the `main` options. If there are others, --help-all lists all options.
    """

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.others = sum(not getattr(param, "main", True) for param in self.params)
        if self.others:
            self.params.append(
                click.Option(
                    ["--help-all"],
                    is_flag=True,
                    is_eager=True,
                    expose_value=False,
                    callback=_help_all,
                    help="Show all options and exit.",
                )
            )

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the sections."""
        sections: dict[str, list[tuple[str, str]]] = {}
        for param in self.get_params(ctx):
            record = isinstance(param, click.Option) and param.get_help_record(ctx)
            if record and (SHOW_ALL in ctx.meta or getattr(param, "main", True)):
                sections.setdefault(getattr(param, "section", "Other"), []).append(record)
        other = sections.pop("Other")
        for heading, records in [*sections.items(), ("Other", other)]:
            with formatter.section(heading):
                formatter.write_dl(records)
        if self.others and SHOW_ALL not in ctx.meta:
            formatter.write(f"\n{self.others} more options: {ctx.command_path} --help-all\n")


def _help_all(ctx: click.Context, param: click.Parameter, value: bool) -> None:
    if value and not ctx.resilient_parsing:
        ctx.meta[SHOW_ALL] = True
        click.echo(ctx.get_help())
        ctx.exit()


class NonEmptyPath(click.Path):
    """A path that is not empty: "", as of a shell variable that is not set, would be the current
    folder."""

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Check and convert a value."""
        if str(value) == "":
            self.fail("is empty; give a path, or . for the current folder", param, ctx)
        return super().convert(value, param, ctx)


PATH = NonEmptyPath(path_type=Path)


class Parsed(click.ParamType):  # type: ignore[type-arg]  # generic only since click 8.3
    """A value that a function makes of a text.

    Parameters
    ----------
    name : the placeholder in the help.
    parse : raises ValueError, whose text says what the value is not, and what to give.
    """

    def __init__(self, name: str, parse: Callable[[str], Any]) -> None:
        self.name, self.parse = name, parse

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Parse a text; another value is one that was parsed."""
        try:
            return self.parse(value) if isinstance(value, str) else value
        except ValueError as error:
            self.fail(f"{value} is {error}", param, ctx)


class FiniteRange(click.FloatRange):
    """A finite number, within limits if there are any; click's own type accepts nan."""

    def _describe_range(self) -> str:
        """The limits in the help, where click writes x<=None for none."""
        return "" if self.min is None and self.max is None else super()._describe_range()

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        """Check and convert a value."""
        number: float = super().convert(value, param, ctx)
        if not math.isfinite(number):
            self.fail(f"{value} is not a finite number", param, ctx)
        return number


class Value(click.ParamType):  # type: ignore[type-arg]  # generic only since click 8.3
    """The value of an option, or one of the option's words."""

    def __init__(self, option: Option) -> None:
        self.option, self.choices = option, option.metadata["choices"]
        kind, count = declared.kind_of(option)
        self.name = "LIST" if count is None else option.metadata["separator"].join("NM") if count else NAMES[kind]

    def get_metavar(self, param: click.Parameter, ctx: click.Context | None = None) -> str:
        """The placeholder in the help."""
        shown = (*self.option.metadata["words"], *(self.choices or (self.name,)))
        return f"[{'|'.join(shown)}]" if len(shown) > 1 else self.name

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        """Parse a value, which is checked later."""
        if not isinstance(value, str):
            return value
        try:
            return declared.parsed(self.option, value)
        except ValueError:
            raise InputError(
                f"{declared.flag_name(self.option.name)} {value}: expects {declared.expected(self.option)}"
            ) from None


def flags_of(kind: type, every: bool = False) -> Callable[[Command], Command]:
    """A decorator that adds a flag for each option of a dataclass that is one, in order.

    Parameters
    ----------
    kind : dataclass of options.
    every : whether the other options become flags as well, for experiments.
    """

    def decorate(command: Command) -> Command:
        for option in reversed(options_of(kind)):
            if not (every or option.metadata["flag"]):
                continue
            names, settings = _flag(option)
            command = click.option(*names, cls=SectionedOption, **settings)(command)
        return command

    return decorate


class TrainingCommand(SectionedCommand):
    """A command with `training_flags`, and those of schedules and parts of other packages.

    Code of others is loaded only for the schedules and parts that the arguments name.
    """

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        """Parse the arguments, by the flags of the schedules and parts among them as well."""
        if not ctx.resilient_parsing:
            self._read_named(ctx, args)
        try:
            return super().parse_args(ctx, args)
        except click.NoSuchOption as error:
            name = error.option_name.removeprefix("--").removeprefix("no-").replace("-", "_")
            if name in {option.name for option in options_of(TrainOptions)}:
                raise InputError(
                    f"{error.option_name}: is a key of the file of --config and no flag; write {name} = VALUE there"
                ) from None
            raise

    def _read_named(self, ctx: click.Context, args: list[str]) -> None:
        """Read the file of --config, and add the flags of what others register and it or the
        arguments name."""
        parser = self.make_parser(ctx)
        parser.ignore_unknown_options = True
        given, _, _ = parser.parse_args(list(args))
        named = f"{given.get('schedule', '')},{given.get('schedules', '')}".split(",")
        schedules = [name for name in named if name and name not in OURS and name in others()]
        config = from_toml(given["config"], *schedules) if given.get("config") else {}
        kind = options_with(
            *schedules, config.get("schedule", TrainOptions.schedule), parts=config.get("add_parts", ())
        )
        own = {option.name for option in options_of(TrainOptions)}
        ctx.meta[OPTIONS], ctx.meta[CONFIG] = kind, config
        ctx.meta[OTHER_FLAGS] = [
            SectionedOption(names, **settings)
            for names, settings in (
                _flag(option) for option in options_of(kind) if option.metadata["flag"] and option.name not in own
            )
        ]

    def format_options(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the sections; --help-all ends with the keys that are no flags."""
        super().format_options(ctx, formatter)
        if SHOW_ALL in ctx.meta:
            with formatter.section("Other keys of the file of --config"):
                formatter.write_dl(
                    [
                        (option.name, f"{option.metadata['help']}  [default: {shown_default(option)}]")
                        for option in options_of(TrainOptions)
                        if not option.metadata["flag"]
                    ]
                )

    def get_params(self, ctx: click.Context) -> list[click.Parameter]:
        """The parameters of the command."""
        return [*ctx.meta.get(OTHER_FLAGS, ()), *super().get_params(ctx)]


def training_flags(command: Command, every: bool = False) -> Command:
    """Add the flags of a training, and the file of its other options; `every` as for `flags_of`."""
    config = click.option(
        "--config", type=PATH, cls=SectionedOption, section="Run", help="TOML file of options; flags override it."
    )
    return flags_of(TrainOptions, every)(config(command))


device_flag = click.option(
    "--device",
    default="auto",
    show_default=True,
    help="auto, cpu, gpu, a number of `clsplat devices`, or part of a name.",
)
moved_scene_flag = click.option("--scene", type=PATH, help="Where the scene is now, if it was moved.")
everything_flag = click.option(
    "--everything",
    is_flag=True,
    help="Keep gaussians at places that fewer than two photos show, which a page and a film leave out.",
)


host_memory_flag = click.option(
    "--host-memory",
    type=click.IntRange(16),
    metavar="MIB",
    help="Host memory, MiB, for what is drawn of a city with a tree. Default: 1024.",
)


def host_bytes(host_memory: int | None, model: Path) -> int:
    """--host-memory in bytes; InputError where it is given for a model that has no tree."""
    from clsplat.io.models.tree import TREE
    from clsplat.rendering.tree import HOST_BYTES

    if host_memory is None:
        return HOST_BYTES
    if not (model / TREE).is_file():
        raise InputError(f"--host-memory: has no effect on {model}, which is no city with a tree; leave it out")
    return host_memory << 20


def check_free(output: Path, overwrite: bool) -> None:
    """InputError if an output exists that must not be overwritten."""
    if output.exists() and not overwrite:
        raise InputError(f"{output}: exists already; replace it with --overwrite, or choose another --output")


def given_options(ctx: click.Context, kind: type | None = None) -> dict[str, Any]:
    """The options of a dataclass, by name, that the user gave as flags; None: of a training."""
    return {
        option.name: ctx.params[option.name]
        for option in options_of(kind or ctx.meta[OPTIONS])
        if option.name in ctx.params and ctx.get_parameter_source(option.name) is not ParameterSource.DEFAULT
    }


def config_options(ctx: click.Context) -> dict[str, Any]:
    """The options of a training, by name, in the file of --config."""
    values: dict[str, Any] = ctx.meta[CONFIG]
    return values


def _flag(option: Option) -> tuple[list[str], dict[str, Any]]:
    """The names of an option's flag, and the settings of a SectionedOption."""
    meta, default, name = option.metadata, option.default, declared.flag_name(option.name)
    kind, count = declared.kind_of(option)
    text = meta["help"]
    if re.split("[:,]", text)[0] not in (*meta["words"], *meta["choices"], default):  # not a value
        text = text[0].upper() + text[1:]
    settings: dict[str, Any] = {"help": f"{text}.", "show_default": True, "default": shown_default(option)}
    if kind is bool:
        name = f"{name}/--no-{name[2:]}"
    elif count is None:  # one list, or several that are joined
        word = shown_default(option)
        settings.update(type=Value(option), multiple=True, default=() if word == () else (word,))
    elif count and not meta["separator"]:
        settings.update(type=kind, nargs=count, default=default)
    else:
        settings["type"] = Value(option)

    def check(ctx: click.Context, param: click.Parameter, value: Any) -> Any:
        if ctx.get_parameter_source(param.name or "") is ParameterSource.DEFAULT:
            return option.default
        return declared.check_flag(option, sum(value, ()) if count is None else value)

    names = [name, option.name] if meta["short"] is None else [meta["short"], name, option.name]
    return names, {
        "section": meta["group"],
        "main": meta["main"],
        "callback": check,
        "envvar": DEVICE if option.name == "device" else None,
        **settings,
    }
