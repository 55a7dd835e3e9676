"""`python -m clsplat` is the command `clsplat`."""

from clsplat.cli.main import main

main(prog_name="clsplat")
