"""`clsplat devices`: the OpenCL devices of this machine, and what to do for those that fail."""

from __future__ import annotations

import platform
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING

import click

from clsplat.errors import DeviceError

if TYPE_CHECKING:
    from clsplat.device.find import ListedDevice

PACKAGES = "clsplat", "pyopencl", "numpy"  # whose versions a report tells
SIZES = ("wave", "item_runs", "group_size", "scan_group", "tile", "bucket", "adjoint_group")  # of a Device


@click.command()
@click.option("--check", is_flag=True, help="Run the correctness self-test on each working device.")
@click.option(
    "--report",
    is_flag=True,
    help="Tell driver, extensions and sizes of each device, "
    "too, for a report to clsplat's developers. Nothing of you or your files is in it.",
)
def devices(check: bool, report: bool) -> None:
    """List all OpenCL devices and whether they work.

    The exit code is 2 if no device works or a check fails.
    """
    from clsplat.device import list_devices
    from clsplat.device.find import NO_DEVICE
    from clsplat.device.tuning import user_rows

    user_rows()  # a file that cannot be used is no fault of a device
    listed = list_devices()
    if report:
        versions = ", ".join(f"{name} {version(name)}" for name in PACKAGES)
        click.echo(
            f"{versions}, Python {platform.python_version()}, {platform.system()} "
            f"{platform.release()}, {platform.machine()}\n"
        )
    if listed:
        click.echo(private(table(listed)))
    working = [entry for entry in listed if entry.works]
    for entry in working if report else ():
        click.echo(f"\n{entry.index}, {entry.name} ({entry.platform})")
        click.echo("\n".join(f"  {name}: {value}" for name, value in facts_of(entry).items()))
    if not working:
        raise DeviceError(NO_DEVICE)
    failed = [entry.name for entry in working if check and not _passes(entry)]
    if failed:
        raise DeviceError(f"the self-test failed on {', '.join(failed)}; update its driver")


def table(listed: Sequence[ListedDevice]) -> str:
    """An aligned row for each device, with its capabilities or why it does not work below."""
    rows = [("", "#", "type", "device", "platform", "verdict")]
    rows += [
        (
            "*" if entry.chosen else "",
            str(entry.index),
            entry.type,
            entry.name,
            entry.platform,
            "works" if entry.works else "does not work",
        )
        for entry in listed
    ]
    widths = [max(map(len, column)) for column in zip(*rows)]
    first, *aligned = ["  ".join(map(str.ljust, row, widths)).rstrip() for row in rows]
    lines = [[line, *(f"      {note}" for note in _notes(entry))] for entry, line in zip(listed, aligned)]
    return "\n".join([first, *sum(lines, []), "* is the device of --device auto"])


def _notes(entry: ListedDevice) -> list[str]:
    if not entry.works:
        return [f"why:  {entry.reason}", f"cure: {entry.cure}"]
    facts = entry.capabilities
    features = [
        name.removeprefix("HAVE_").lower().replace("_", " ")
        for name, available in facts.items()
        if name.startswith("HAVE_") and available
    ]
    return [
        ", ".join(
            [
                f"{facts['compute_units']} compute units",
                f"{facts['memory_bytes'] / 2**30:.1f} GiB memory",
                f"largest buffer {facts['largest_buffer_bytes'] / 2**30:.1f} GiB",
                f"{facts['local_bytes'] >> 10} KiB local memory",
                facts["opencl_c"],
                *features,
            ]
        )
    ]


def facts_of(entry: ListedDevice) -> dict[str, str]:
    """What a report tells of a working device: its driver, what it can do, and the sizes that
    clsplat chose for it."""
    from clsplat.device import Device

    handle = entry.handle
    try:
        device = Device(handle)
    except Exception as error:  # noqa: BLE001  (a driver may raise anything, and that is told)
        return {
            "driver": handle.driver_version.strip(),
            "cannot be opened": private(f"{type(error).__name__}: {error}"),
        }
    return {
        "driver": handle.driver_version.strip(),
        "OpenCL": handle.version.strip(),
        "work-items of a group, at most": f"{handle.max_work_group_size:,}",
        "address bits": str(handle.address_bits),
        "form": device.form,
        **{name.replace("_", " "): str(getattr(device, name)) for name in SIZES},
        "extensions": " ".join(sorted(handle.extensions.split())),
    }


def private(text: str) -> str:
    """A text, perhaps of a driver, without the path of the home folder, which has a name."""
    return text.replace(str(Path.home()), "~")


def _passes(entry: ListedDevice) -> bool:
    """Run and print the self-test of one device; whether all its checks passed."""
    from clsplat.bench.selftest import check
    from clsplat.device import choose_device

    click.echo(f"\nself-test of {entry.index}, {entry.name} ({entry.platform})")
    results = check(choose_device(str(entry.index)))
    for name, passed, detail in results:
        click.echo(private(f"  {'ok    ' if passed else 'FAILED'}  {name}: {detail}"))
    return all(passed for _, passed, _ in results)
