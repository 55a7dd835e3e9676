"""`clsplat bench`: the timings of one kernel family."""

from __future__ import annotations

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

    ARGUMENTS go to the benchmark, such as --gaussians 200k,1M,4M or --form group; `clsplat bench
    FAMILY -- --help` lists them.
    """
    from clsplat.bench import families, run
    if family is None:
        click.echo("\n".join(families()))
    elif family in families():
        run(family, [*["--json"] * as_json, *(["--device", device] if device else []), *arguments])
    else:
        raise InputError(f"unknown benchmark '{family}'; known: {', '.join(families())}")
