"""`clsplat mesh`: the surface of a run as triangles."""

from pathlib import Path

import click

from clsplat.cli.flags import PATH, FiniteRange, check_free, device_flag, moved_scene_flag


@click.command()
@click.argument("run", type=PATH)
@click.option(
    "-o", "--output", required=True, type=PATH, help="File to write; its suffix selects the format: .glb, .ply or .obj."
)
@click.option(
    "--voxel",
    type=FiniteRange(0, min_open=True),
    help="Size of the finest detail, metres; of a scene without georeference scene "
    "units. Default: the size of a pixel of the photos.",
)
@click.option("--overwrite", is_flag=True, help="Replace an existing file.")
@moved_scene_flag
@device_flag
def mesh(run: Path, output: Path, voxel: float | None, overwrite: bool, scene: Path | None, device: str) -> None:
    """Write the surface of RUN as triangles with colours of vertices.

    Places that fewer than two views show, or of whose depth the model is unsure, are left out: the
    surface is open there. Coordinates are the original ones of the scene; the file names the offset
    to those of the map.
    """
    from clsplat.apps.mesh import open_edges, run_mesh
    from clsplat.cli.progress import Progress
    from clsplat.device import choose_device
    from clsplat.evaluation.run import Run
    from clsplat.io.models.mesh import check_suffix, write_mesh
    from clsplat.io.models.values import Notes

    check_suffix(output)
    check_free(output, overwrite)
    opened = Run.open(run)
    data = opened.scene(scene)
    place = opened.georeference
    with Progress() as progress:
        progress.phase("opening the device")
        made = run_mesh(opened, data, choose_device(device), voxel, progress)
        progress.phase(f"writing {output}")
        write_mesh(output, made, Notes((), opened.up, place))
    edges = open_edges(made)
    unit = "m" if place is not None else "scene units"
    click.echo(
        f"{output}: {len(made.triangles):,} triangles, {len(made.vertices):,} vertices, "
        f"voxels of {made.voxel:g} {unit}, "
        f"{f'{edges:,} open edges' if edges else 'watertight'}, "
        f"{place.crs if place is not None else 'no georeference'}"
    )
