"""Help texts in sections, for groups of commands and for commands with many options."""

from __future__ import annotations

from typing import Any

import click

SHOW_ALL = "clsplat.help_all"  # in a context's `meta` if its help lists every option


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
            self.params.append(click.Option(
                ["--help-all"], is_flag=True, is_eager=True, expose_value=False, callback=_help_all,
                help="Show all options and exit."))

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


class SectionedGroup(click.Group):
    """A group of commands whose help lists them under headings."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.sections: dict[str, list[str]] = {}

    def add_section(self, heading: str, *commands: click.Command) -> None:
        """Add commands, which the help lists in this order under `heading`."""
        self.sections[heading] = [command.name or "" for command in commands]
        for command in commands:
            self.add_command(command)

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the sections."""
        width = formatter.width - 6 - max(map(len, self.commands))
        for heading, names in self.sections.items():
            with formatter.section(heading):
                formatter.write_dl(
                    [(name, self.commands[name].get_short_help_str(width)) for name in names])
