"""`clsplat bench`: the timings of one kernel family, or error against run time."""

from __future__ import annotations

import importlib

import click

from clsplat.errors import InputError


@click.command(context_settings={"ignore_unknown_options": True})
@click.argument("family", required=False)
@click.option("--json", "as_json", is_flag=True, help="Print JSON, one record a line.")
@click.option("--device", help="As for `clsplat train`.")
@click.argument("arguments", nargs=-1, type=click.UNPROCESSED)
def bench(family: str | None, as_json: bool, device: str | None, arguments: tuple[str, ...]
          ) -> None:
    """Time the kernels of a FAMILY; without FAMILY, list all.

    The family `precision` compares approximations by error and time; add --html OUT.html for a
    page. ARGUMENTS go to the benchmark, such as --gaussians 200k,1M,4M or --form group; `clsplat
    bench FAMILY -- --help` lists them.
    """
    from clsplat.bench import families as listed
    families = listed()
    if family is None:
        click.echo("\n".join(families))
        return
    if family not in families:
        raise InputError(f"unknown benchmark '{family}'; known: {', '.join(families)}")
    flags = (["--json"] if as_json else []) + (["--device", device] if device else [])
    importlib.import_module(f"clsplat.bench.{family}").main([*flags, *arguments])
