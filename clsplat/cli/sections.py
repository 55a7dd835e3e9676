"""Help in sections, for groups of commands and for commands with many options."""

import click


class SectionedOption(click.Option):
    """An option that the help lists under the heading `section`."""

    def __init__(self, *args, section, **kwargs):
        super().__init__(*args, **kwargs)
        self.section = section


class SectionedCommand(click.Command):
    """A command whose help has one section for each heading among its options."""

    def format_options(self, ctx, formatter):
        sections = {}
        for param in self.get_params(ctx):
            if isinstance(param, click.Option):
                heading = getattr(param, "section", "Other")
                sections.setdefault(heading, []).append(param.get_help_record(ctx))
        other = sections.pop("Other")
        for heading, records in [*sections.items(), ("Other", other)]:
            with formatter.section(heading):
                formatter.write_dl(records)


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
