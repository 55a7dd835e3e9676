"""Help in sections, for groups of commands and for commands with many options."""

import click

ALL = "clsplat.help_all"  # in a context: whether its help lists every option


class SectionedOption(click.Option):
    """An option that the help lists under the heading `section`; unless it is `main`, only
    --help-all does."""

    def __init__(self, *args, section, main=True, **kwargs):
        super().__init__(*args, **kwargs)
        self.section, self.main = section, main


class SectionedCommand(click.Command):
    """A command whose help has one section for each heading among its options.

    --help lists those that are `main`; where there are others, --help-all lists these too.
    """

    def __init__(self, *args, **kwargs):
        super().__init__(*args, **kwargs)
        self.others = sum(not getattr(param, "main", True) for param in self.params)
        if self.others:
            self.params.append(click.Option(
                ["--help-all"], is_flag=True, is_eager=True, expose_value=False, callback=_help_all,
                help="Show all options and exit."))

    def format_options(self, ctx, formatter):
        sections = {}
        for param in self.get_params(ctx):
            shown = ALL in ctx.meta or getattr(param, "main", True)
            if isinstance(param, click.Option) and shown:
                heading = getattr(param, "section", "Other")
                sections.setdefault(heading, []).append(param.get_help_record(ctx))
        other = sections.pop("Other")
        for heading, records in [*sections.items(), ("Other", other)]:
            with formatter.section(heading):
                formatter.write_dl(records)
        if self.others and ALL not in ctx.meta:
            formatter.write(f"\n{self.others} more options: {ctx.command_path} --help-all\n")


def _help_all(ctx, param, value):
    if value and not ctx.resilient_parsing:
        ctx.meta[ALL] = True
        click.echo(ctx.get_help())
        ctx.exit()


class SectionedGroup(click.Group):
    """A group whose help lists commands under the headings they were added with."""

    def __init__(self, *args, **kwargs):
        super().__init__(*args, **kwargs)
        self.sections = {}

    def add_section(self, heading, *commands):
        """Add commands, listed in this order under `heading`."""
        self.sections[heading] = [command.name for command in commands]
        for command in commands:
            self.add_command(command)

    def format_commands(self, ctx, formatter):
        width = formatter.width - 6 - max(map(len, self.commands))
        for heading, names in self.sections.items():
            with formatter.section(heading):
                formatter.write_dl(
                    [(name, self.commands[name].get_short_help_str(width)) for name in names])
