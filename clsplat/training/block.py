"""Trains one block of a larger scene from its folder, which contains all that it needs."""

from typing import Any

from clsplat.config.option import differences
from clsplat.device import choose_device
from clsplat.errors import InputError
from clsplat.io.city import DEPTH, BlockFolder
from clsplat.io.run import OPTIONS, RunFolder
from clsplat.io.scenes import read_scene
from clsplat.options import EARLIER, TrainOptions, checked, resolve
from clsplat.training.loop import resume, train
from clsplat.training.progress import NotedProgress, SilentProgress

# options that the coarse run decides, so that all blocks agree on colours and SH degree
DECIDED = ("exposure", "vignetting", "tone", "sh_degree")
MAY_DIFFER = "init"  # a path in the block's folder, which may have been moved


def decided_by(coarse: RunFolder) -> dict[str, Any]:
    """{option: value} that a coarse run has decided for all blocks."""
    decisions, path = coarse.read_options().get("decisions"), coarse.path / OPTIONS
    known = {**EARLIER, **decisions} if isinstance(decisions, dict) else {}
    if not set(DECIDED) <= set(known):
        raise InputError(f"{path}: damaged (decisions is {str(decisions)[:20]!r}); remove "
                         f"{coarse.path}, and train it again")
    return {name: checked(str(path), name, known[name]) for name in DECIDED}


def options_of_blocks(given: dict[str, Any], decided: dict[str, Any]) -> dict[str, Any]:
    """{option: value} of every block, for `CityFolder.write_block`.

    Blocks have training views only, so none is held out. Their gaussians have spherical harmonics
    from the start, so all degrees are active at once.

    Parameters
    ----------
    given : options that the user sets for blocks.
    decided : those of `decided_by`.
    """
    given = {name: value for name, value in given.items() if name != "images"}  # it has links
    depth = {"depth": DEPTH} if given.get("depth") else {}
    return {"sh_every": 1, **given, **depth, **decided, "coarse": False, "test_every": 0,
            "test_offset": 0}


def block_options(block: BlockFolder, **changes: Any) -> TrainOptions:
    """The options in a block's folder, with changes; InputError for invalid ones."""
    values = {key: checked(str(block.path), key, value)
              for key, value in block.read()["options"].items()}
    return resolve(values, {"init": str(block.initial), **changes})


def train_block(block: BlockFolder, options: TrainOptions,
                progress: SilentProgress | None = None, patience: float = 0.0) -> bool:
    """Train a block to its end, from the start or from the last checkpoint of its run.

    Parameters
    ----------
    block : its folder.
    options : those of `block_options`.
    progress : receives steps, messages and phases.
    patience : seconds to wait for another process that trains the block.

    Returns
    -------
    Whether it had to be trained: a finished run is not trained again.

    Raises
    ------
    InputError : for a run that was begun with other options.
    """
    run = RunFolder(block.run)
    if run.is_finished:  # checked before locking: the disk may be read-only
        _check_same(run, options)
        return False
    with run.locked(patience):
        begun = run.is_begun
        if begun:
            _check_same(run, options)
        if run.is_finished:
            return False
        scene = read_scene(block.path)
        device = choose_device(options.device, form=options.form)
        run, start = (run, resume) if begun else (RunFolder.create(run.path), train)
        noted = NotedProgress(run.path, progress or SilentProgress())
        start(scene, options, device, run, progress=noted)
    return True


def _check_same(run: RunFolder, options: TrainOptions) -> None:
    for name, recorded, present in differences(run.read_options(), options):
        if name != MAY_DIFFER:
            raise InputError(f"{run.path}: was begun with {name} {recorded}, and block.json has "
                             f"{present}; put that back, or remove the run")
