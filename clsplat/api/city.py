"""`clsplat.city`: train a large scene in blocks."""

from collections.abc import Mapping, Sequence
from os import PathLike
from pathlib import Path
from typing import Any

from clsplat.api.options import TrainOptions, resolved
from clsplat.api.run import Run
from clsplat.api.trainer import folder_of
from clsplat.cities import run
from clsplat.config.option import checked
from clsplat.io.runs.run import RunFolder
from clsplat.io.scenes.read import read_scene
from clsplat.partition.options import PartitionOptions
from clsplat.scene import Scene


def city(
    scene: Scene | str | PathLike[str],
    options: TrainOptions | None = None,
    *,
    output: str | PathLike[str] | None = None,
    partition: Mapping[str, Any] | None = None,
    workers: int | None = None,
    devices: Sequence[str] = (),
    scheduler: str = "",
    fill: bool = False,
) -> Run:
    """Train a large scene in blocks, and merge them; the same as `clsplat city`.

    After any failure, the same call continues. With several workers a script needs
    `if __name__ == "__main__":`, as its processes import it.

    Parameters
    ----------
    scene : a Scene as it was read, from files, or its path.
    options : of the training of the whole; None: the defaults.
    output : the folder of the city; None: a new one in the folder for temporary files.
    partition : options of `clsplat partition --help`, by name, such as {"grid": (2, 2)}; others are
        chosen by the scene and the device.
    workers : how many blocks are trained at a time on this machine; None: one for each device, or
        as many as share a GPU well. With a scheduler: for how many workers to cut.
    devices : names of devices, as in `clsplat devices`; none: that of the options.
    scheduler : address of a Dask scheduler, whose workers train the blocks.
    fill : whether the coarse model's gaussians are used if a block fails.

    Returns
    -------
    The Run of the merged model.

    Raises
    ------
    clsplat.ClsplatError : if the scene, an option or the folder cannot be used, or a block fails.
    """
    chosen, folder = resolved(options), folder_of(output)
    cut = {name: checked(PartitionOptions, "partition", name, value) for name, value in (partition or {}).items()}
    data = scene if isinstance(scene, Scene) else read_scene(Path(scene).absolute(), chosen.images)
    run.city(data, chosen, folder, partition=cut, workers=workers, devices=devices, scheduler=scheduler, fill=fill)
    return Run(RunFolder.open(folder))
