"""`clsplat compare-surveys`: what changed between two surveys of one place."""

from pathlib import Path

import click

from clsplat.cli.flags import PATH, check_free, device_flag
from clsplat.cli.measure import surface_file


@click.command("compare-surveys")
@click.argument("before", type=PATH)
@click.argument("after", type=PATH)
@click.option("-o", "--output", required=True, type=PATH, help="Folder for the files.")
@click.option("--overwrite", is_flag=True, help="Replace the files of an earlier comparison.")
@device_flag
def compare_surveys(before: Path, after: Path, output: Path, overwrite: bool, device: str) -> None:
    """Show what changed from survey BEFORE to survey AFTER.

    Each is a GeoTIFF of heights, the folder of a map, or a run, whose map is then drawn. AFTER is
    moved onto BEFORE by the ground that did not change. Writes the moved surface and the difference
    as GeoTIFF, with styles for QGIS, a picture and a record.
    """
    from clsplat.apps.surveys import FILES, write_comparison

    for name in FILES:
        check_free(output / name, overwrite)
    with surface_file(before, None, device) as early, surface_file(after, None, device) as late:
        record = write_comparison(early, late, output, (str(before), str(after)))
    unit, shift = "m" if record["crs"] else "units", record["shift"]
    click.echo(
        f"{output}: moved by {shift['east']:.3f} to the east, {shift['north']:.3f} to the "
        f"north and {shift['up']:.3f} {unit} up; {record['compared']:.0%} compared"
    )
    if not record["horizontal_shift_found"]:
        click.echo(f"{output}: warning: the ground is too level to show a shift along it; rely on control points")
    click.echo(
        f"{output}: noise on stable ground {record['noise']:.3f} {unit} (NMAD), level of "
        f"detection {record['level_of_detection']:.3f} {unit}"
    )
    click.echo(
        f"{output}: fill {record['fill']:,.1f}, cut {record['cut']:,.1f} {unit}³, on {record['changed']:,.1f} {unit}²"
    )
