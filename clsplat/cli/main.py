"""The command `clsplat`: its commands, and how errors reach the user."""

import sys
import traceback

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
from clsplat.cli.plan import plan
from clsplat.cli.render import render
from clsplat.cli.sections import SectionedGroup
from clsplat.cli.synth import synth
from clsplat.cli.train import train
from clsplat.errors import ClsplatError, Interrupted


class Reporting(SectionedGroup):
    """Turns every failure into an exit code, and the user's own into one line."""

    def main(self, args=None, prog_name=None, **extra):
        """Run and exit: 0 done, 2 an error the user can cure, 1 a bug, 130 interrupted."""
        args = list(sys.argv[1:] if args is None else args)
        extra["standalone_mode"] = False
        sys.exit(self._run("--traceback" in args, args, prog_name, extra))

    def _run(self, with_traceback, args, prog_name, extra):
        try:
            code = super().main(args, prog_name, **extra)
            return code if isinstance(code, int) else 0
        except (Exception, KeyboardInterrupt) as error:  # noqa: BLE001  (the outermost place)
            message, code = verdict(error)
            if with_traceback or code == 1:
                traceback.print_exception(error)
            click.echo(message, err=True)
            return code


def verdict(error):
    """(what to say, exit code) of an exception that ended a command."""
    if isinstance(error, click.UsageError):
        command = error.ctx.command_path if error.ctx else "clsplat"
        return f"error: {error.format_message()} See `{command} --help`.", 2
    if isinstance(error, click.ClickException):
        return f"error: {error.format_message()}", 2
    if isinstance(error, (KeyboardInterrupt, click.Abort)):
        return "interrupted", 130
    if isinstance(error, Interrupted):
        return str(error), 130
    if isinstance(error, ClsplatError):
        return f"error: {error}", 2
    return "error: this is a bug in clsplat; please report it with the lines above", 1


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
main.add_section("Data", synth)
main.add_section("Machine", devices, bench, completion)

# `main` looks for the flag in the arguments; as an option it shows in help and may stand anywhere
for _command in (main, *main.commands.values()):
    _command.params.append(click.Option(
        ["--traceback"], is_flag=True, expose_value=False,
        help="Show where in the code an error arose."))
