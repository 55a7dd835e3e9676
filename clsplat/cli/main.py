"""The command `clsplat`: its subcommands, and how errors are reported to the user."""

import math
import signal
import sys
import traceback
from collections.abc import Sequence
from contextlib import suppress
from typing import Any, NoReturn

import click

from clsplat import __version__
from clsplat.cli.bench import bench, tune
from clsplat.cli.city import block, city, merge, partition_command
from clsplat.cli.devices import devices
from clsplat.cli.edit import edit
from clsplat.cli.evaluate import compare, evaluate
from clsplat.cli.export import export
from clsplat.cli.film import film
from clsplat.cli.georeference import georeference
from clsplat.cli.map import map_command
from clsplat.cli.measure import measure
from clsplat.cli.mesh import mesh
from clsplat.cli.pack import pack
from clsplat.cli.plan import plan
from clsplat.cli.render import render
from clsplat.cli.sfm import sfm
from clsplat.cli.surveys import compare_surveys
from clsplat.cli.train import train
from clsplat.cli.view import view
from clsplat.errors import ClsplatError, Interrupted
from clsplat.training.interrupt import handled_interrupts

BUG = 1  # exit code
SIGPIPE = 13  # its number where it exists; Windows has none
CURE = "check that it exists, that it may be read or written, and that the disk has space"


class Reporting(click.Group):
    """A group of commands under headings, which turns every failure into an exit code, and errors
    of the user into one line."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.sections: dict[str, list[str]] = {}

    def add_section(self, heading: str, *commands: click.Command) -> None:
        """Add commands, which the help lists in this order under `heading`."""
        self.sections[heading] = [command.name or "" for command in commands]
        for command in commands:
            self.add_command(command)

    def resolve_command(
        self, ctx: click.Context, args: list[str]
    ) -> tuple[str | None, click.Command | None, list[str]]:
        """The command that the arguments begin with, whose name may have two words."""
        name = " ".join(args[:2])
        return (name, self.commands[name], args[2:]) if name in self.commands else super().resolve_command(ctx, args)

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """Write the sections."""
        width = formatter.width - 6 - max(map(len, self.commands))
        for heading, names in self.sections.items():
            with formatter.section(heading):
                formatter.write_dl([(name, self.commands[name].get_short_help_str(width)) for name in names])

    def main(
        self,
        args: Sequence[str] | None = None,
        prog_name: str | None = None,
        complete_var: str | None = None,
        standalone_mode: bool = True,
        **extra: Any,
    ) -> NoReturn:
        """Run a command and exit.

        The exit code is 0 if the command is done, 2 for an error that the user can cure, 1 for a
        bug, 130 if it was interrupted (143 by SIGTERM), and 141 if the reader of a pipe has closed
        it. The arguments are those of click; `standalone_mode` is ignored.
        """
        arguments = list(sys.argv[1:] if args is None else args)
        with handled_interrupts() as interrupts:
            try:
                result = super().main(arguments, prog_name, complete_var, standalone_mode=False, **extra)
                sys.stdout.flush()
                code = result if isinstance(result, int) else 0
            except (Exception, KeyboardInterrupt) as error:  # noqa: BLE001  (the outermost place)
                interrupts.deferred = math.inf  # what is left is to print how it ended
                message, code = verdict(error, next(iter(interrupts.received), 0))
                if "--traceback" in arguments or code == BUG:
                    say("".join(traceback.format_exception(error)).rstrip())
                if message:
                    say(message)
            except SystemExit as end:  # click exits with 1 for a pipe that its reader closed
                if end.code != 1:
                    raise
                code = 128 + SIGPIPE
        sys.exit(code)


def verdict(error: BaseException, signalled: int = 0) -> tuple[str, int]:
    """The message and the exit code for an exception that ended a command.

    Parameters
    ----------
    error : the exception.
    signalled : the number of the signal that was sent to end the command, or 0. A library may have
        turned its KeyboardInterrupt into an exception of its own.
    """
    stopped = 128 + (signalled or signal.SIGINT)
    if isinstance(error, Interrupted):
        return str(error), stopped
    if signalled or isinstance(error, (KeyboardInterrupt, click.Abort)):
        cause = error.__cause__ or error
        where = f" {text}" if isinstance(cause, KeyboardInterrupt) and (text := str(cause).strip()) else ""
        return f"interrupted{where}: give the same command again", stopped
    if isinstance(error, click.UsageError):
        command = error.ctx.command_path if error.ctx else "clsplat"
        return f"error: {error.format_message()} See `{command} --help`.", 2
    if isinstance(error, click.ClickException):
        return f"error: {error.format_message()}", 2
    if isinstance(error, ClsplatError):
        return f"error: {error}", 2
    if isinstance(error, BrokenPipeError):
        return "", 128 + SIGPIPE
    if isinstance(error, OSError) and error.strerror:
        return f"error: {error.filename or 'the output'}: {error.strerror}; {CURE}", 2
    if isinstance(error, MemoryError):
        return (
            "error: this machine does not have enough memory left; close other programs, or "
            "use smaller images with --downscale or --max-resolution"
        ), 2
    return (
        "error: this is a bug in clsplat, or in the package of others that the lines above "
        "name; please report it with these lines"
    ), BUG


def say(text: str) -> None:
    """Print a line to standard error, if that is open."""
    with suppress(OSError, ValueError, AttributeError):
        click.echo(text, err=True)


@click.group(cls=Reporting, invoke_without_command=True, context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(__version__, prog_name="clsplat", message="%(prog)s %(version)s")
@click.pass_context
def main(ctx: click.Context) -> None:
    """Train Gaussian splats of real scenes on any OpenCL device.

    Start with `clsplat train PHOTOS -o RUN`: a folder of photos is enough. `clsplat view RUN` shows
    the model, `clsplat export RUN -o RUN.html` makes a page to send, `clsplat map RUN -o MAP` an
    orthophoto. With camera poses, as in a COLMAP folder, give that folder in place of PHOTOS.
    """
    if ctx.invoked_subcommand is None:
        click.echo(ctx.get_help())


main.add_section("Train", plan, train, evaluate, compare)
main.add_section("Results", render, view, export, edit, mesh, film)
main.add_section("Maps", map_command, measure, compare_surveys)
main.add_section("Large scenes", city, partition_command, block, merge)
main.add_section("Data", sfm, georeference, pack)
main.add_section("Machine", devices, bench, tune)

# `Reporting` finds the flag in the arguments; as an option it is in the help and allowed anywhere
for _command in (main, *main.commands.values()):
    _command.params.append(
        click.Option(["--traceback"], is_flag=True, expose_value=False, help="Show where in the code an error arose.")
    )
