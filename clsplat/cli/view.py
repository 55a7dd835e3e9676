"""`clsplat view`: look at a run's model in the browser, drawn by clsplat."""

from pathlib import Path

import click

from clsplat.cli.flags import PATH, device_flag, host_bytes, host_memory_flag


@click.command(short_help="Look at the model of RUN in the browser.")
@click.argument("run", type=PATH)
@click.option("--port", type=click.IntRange(0, 65535), default=0, help="Port of the page; default: any that is free.")
@host_memory_flag
@device_flag
def view(run: Path, port: int, host_memory: int | None, device: str) -> None:
    """Show the model of RUN on a page for the browser, until Ctrl-C.

    clsplat draws every frame itself, so the page works in any browser. It can only be opened on
    this machine, by the address that is printed. For a page that can be sent, see `clsplat export`.
    """
    from clsplat.apps.live import show_run
    from clsplat.device import choose_device
    from clsplat.evaluation.run import Run

    opened = Run.open(run)
    most = host_bytes(host_memory, run)
    try:
        show_run(opened, choose_device(device), announce, port, most)
    except KeyboardInterrupt:
        click.echo("closed")


def announce(address: str) -> None:
    """Tell the address of a page."""
    click.echo(f"open in a browser on this machine: {address}")
