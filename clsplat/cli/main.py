"""The command `clsplat`: its commands, and how errors reach the user."""

import signal
import sys
import traceback
from contextlib import suppress
from pathlib import Path

import click

from clsplat import __version__
from clsplat.cli.bench import bench
from clsplat.cli.block import block
from clsplat.cli.city import city, merge, partition_command
from clsplat.cli.compare import compare
from clsplat.cli.completion import completion
from clsplat.cli.devices import devices
from clsplat.cli.evaluate import evaluate
from clsplat.cli.export import export
from clsplat.cli.flags import GivenPath
from clsplat.cli.pack import pack
from clsplat.cli.plan import plan
from clsplat.cli.render import render
from clsplat.cli.sections import SectionedGroup
from clsplat.cli.synth import synth
from clsplat.cli.train import train
from clsplat.errors import ClsplatError, Interrupted
from clsplat.training.interrupt import handled_interrupts

BUG = 1  # exit code
SIGPIPE = 13  # its number where it exists; Windows has none
CURE = "check that it exists, that it may be read or written, and that the disk has space"


class Reporting(SectionedGroup):
    """Turns every failure into an exit code, and the user's own into one line."""

    def main(self, args=None, prog_name=None, **extra):
        """Run and exit: 0 done, 2 an error the user can cure, 1 a bug, 130 interrupted (143 by
        SIGTERM), 141 where nobody reads what is printed any more."""
        args = list(sys.argv[1:] if args is None else args)
        extra["standalone_mode"] = False
        sys.exit(self._run("--traceback" in args, args, prog_name, extra))

    def _run(self, with_traceback, args, prog_name, extra):
        with handled_interrupts() as interrupts:
            try:
                code = super().main(args, prog_name, **extra)
                sys.stdout.flush()
                return code if isinstance(code, int) else 0
            except (Exception, KeyboardInterrupt) as error:  # noqa: BLE001  (the outermost place)
                message, code = verdict(error, interrupts.number)
                if with_traceback or code == BUG:
                    say("".join(traceback.format_exception(error)).rstrip())
                if message:
                    say(message)
                return code
            except SystemExit as end:  # 1 is click's answer to a pipe that nobody reads
                return 128 + SIGPIPE if end.code == 1 else end.code


def verdict(error, signalled=0):
    """(what to say, exit code) of an exception that ended a command.

    signalled: number of the signal that was sent to end the command, or 0. Libraries may have
    turned its KeyboardInterrupt into an exception of their own.
    """
    stopped = 128 + (signalled or signal.SIGINT)
    if isinstance(error, Interrupted):
        return str(error), stopped
    if signalled or isinstance(error, (KeyboardInterrupt, click.Abort)):
        return "interrupted; what was saved is kept: give the same command again", stopped
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
    no_room = isinstance(error, ImportError) and "failed to map segment" in str(error)
    if no_room or isinstance(error, MemoryError):
        return ("error: this machine has not enough memory left for this; close other programs, or "
                "use smaller images with --downscale or --max-resolution"), 2
    return "error: this is a bug in clsplat; please report it with the lines above", BUG


def say(text):
    """A line on standard error, if anybody can still read it."""
    with suppress(OSError, ValueError, AttributeError):
        click.echo(text, err=True)


@click.group(cls=Reporting, invoke_without_command=True,
             context_settings={"help_option_names": ["-h", "--help"]})
@click.version_option(__version__, prog_name="clsplat", message="%(prog)s %(version)s")
@click.pass_context
def main(ctx):
    """Train Gaussian splats of real scenes on any OpenCL device.

    Start with `clsplat devices`, then `clsplat train SCENE -o RUN` on a COLMAP scene and
    `clsplat eval RUN`.
    """
    if ctx.invoked_subcommand is None:
        click.echo(ctx.get_help())


main.add_section("Train", plan, train, evaluate, compare, render, export)
main.add_section("Large scenes", city, partition_command, block, merge)
main.add_section("Data", synth, pack)
main.add_section("Machine", devices, bench, completion)

# `main` looks for the flag in the arguments; as an option it shows in help and may stand anywhere
for _command in (main, *main.commands.values()):
    _command.params.append(click.Option(
        ["--traceback"], is_flag=True, expose_value=False,
        help="Show where in the code an error arose."))
    for _parameter in _command.params:
        if isinstance(_parameter.type, click.Path):
            _parameter.type = GivenPath(path_type=Path)
