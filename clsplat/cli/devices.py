"""`clsplat devices`: what OpenCL offers on this machine, what works, and the cure for the rest."""

import sys

import click

NONE = ("no OpenCL device; install one: `pip install intel-opencl-rt intel-cmplr-lib-rt` "
        "(Linux, any x86-64 CPU), `apt-get install pocl-opencl-icd`, or your GPU vendor's driver")


@click.command()
@click.option("--check", is_flag=True, help="Run the correctness self-test on each that works.")
def devices(check):
    """List every OpenCL device with a verdict; exit 2 where none works or a check fails."""
    from clsplat.device import list_devices
    found = list_devices()
    click.echo(table(found) if found else NONE)
    working = [entry for entry in found if entry.works]
    good = [_passes(entry) for entry in working] if check else []
    sys.exit(0 if working and all(good) else 2)


def table(found):
    """One aligned row a device, and under it what it can do, or why it does not work."""
    rows = [("", "#", "type", "device", "platform", "verdict")]
    rows += [("*" if entry.chosen else "", str(entry.index), entry.type, entry.name,
              entry.platform, "works" if entry.works else "does not work") for entry in found]
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    aligned = ["  ".join(cell.ljust(width) for cell, width in zip(row, widths)).rstrip()
               for row in rows]
    lines = aligned[:1]
    for entry, line in zip(found, aligned[1:]):
        lines += [line, *(f"      {note}" for note in _notes(entry))]
    return "\n".join([*lines, "* is what --device auto takes"])


def _notes(entry):
    if not entry.works:
        return [f"why:  {entry.reason}", f"cure: {entry.cure}"]
    able = entry.capabilities
    features = [name.removeprefix("HAVE_").lower().replace("_", " ")
                for name, has in able.items() if name.startswith("HAVE_") and has]
    return [", ".join([
        f"{able['compute_units']} compute units",
        f"{able['memory_bytes'] / 2**30:.1f} GiB memory",
        f"largest buffer {able['largest_buffer_bytes'] / 2**30:.1f} GiB",
        f"{able['local_bytes'] >> 10} KiB local", able["opencl_c"], *features])]


def _passes(entry):
    """Print the self-test of one device; whether all of it passed."""
    from clsplat.bench.selftest import check
    from clsplat.device import open_device
    click.echo(f"\nself-test of {entry.index}, {entry.name} ({entry.platform})")
    results = check(open_device(entry.index))
    for name, passed, detail in results:
        click.echo(f"  {'ok    ' if passed else 'FAILED'}  {name}: {detail}")
    return all(passed for _, passed, _ in results)
