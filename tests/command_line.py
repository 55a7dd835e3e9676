"""The command line as a user calls it, in this process."""

from click.testing import CliRunner

from clsplat.cli.main import main


def clsplat_(*words):
    """click's result of a command, whose words may be paths and numbers."""
    return CliRunner().invoke(main, [str(word) for word in words])
