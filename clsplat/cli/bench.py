"""`clsplat bench`: the timings of one kernel family, or error against run time."""

import importlib

import click

from clsplat.errors import InputError


@click.command(context_settings={"ignore_unknown_options": True})
@click.argument("family", required=False)
@click.option("--json", "as_json", is_flag=True, help="One JSON record a line.")
@click.option("--device", help="As for `clsplat train`.")
@click.argument("arguments", nargs=-1, type=click.UNPROCESSED)
def bench(family, as_json, device, arguments):
    """Time a kernel FAMILY on this machine; without one, list them.

    `precision` compares approximations by error and time: add --html OUT.html. Further ARGUMENTS go
    to the benchmark, such as --gaussians 200k,1M,4M or --form group; -- --help lists them.
    """
    from clsplat.bench import families as listed
    families = listed()
    if family is None:
        click.echo("\n".join(families))
        return
    if family not in families:
        raise InputError(f"no benchmark is called '{family}'; there are {', '.join(families)}")
    flags = (["--json"] if as_json else []) + (["--device", device] if device else [])
    importlib.import_module(f"clsplat.bench.{family}").main([*flags, *arguments])
