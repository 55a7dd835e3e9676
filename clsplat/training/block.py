"""Trains one block of a larger scene, from the folder that says all about it."""

from clsplat.config.option import differences
from clsplat.device import choose_device
from clsplat.errors import InputError
from clsplat.io.run import OPTIONS, RunFolder
from clsplat.io.scenes import read_scene
from clsplat.options import checked, resolve
from clsplat.training.loop import resume, train

# what the coarse run has decided for all blocks, or their tones and degrees would not meet
DECIDED = ("exposure", "sh_degree")
MOVES = "init"  # a path in the block's folder


def decided_by(coarse):
    """{option: value} that a coarse run, a RunFolder, has decided for all blocks."""
    decisions, path = coarse.read_options().get("decisions"), coarse.path / OPTIONS
    if not isinstance(decisions, dict) or not set(DECIDED) <= set(decisions):
        raise InputError(f"{path}: damaged (decisions is {str(decisions)[:20]!r}); remove "
                         f"{coarse.path}, and train it again")
    return {name: checked(str(path), name, decisions[name]) for name in DECIDED}


def options_of_blocks(given, decided):
    """{option: value} of every block, for CityFolder.write_block.

    given: what the user asks of blocks; decided: see `decided_by`. Blocks hold out nothing: they
    are given training views only. The gaussians have their harmonics already, so these are not
    switched on one by one.
    """
    given = {name: value for name, value in given.items() if name != "images"}  # links to them
    return {"sh_every": 1, **given, **decided, "coarse": False, "test_every": 0}


def block_options(block, **changes):
    """The TrainOptions of a BlockFolder, changed as given; InputError for what is none."""
    values = {key: checked(str(block.path), key, value)
              for key, value in block.read()["options"].items()}
    return resolve(values, {"init": str(block.initial), **changes})


def train_block(block, options, progress=None, patience=0.0):
    """Train a BlockFolder to its end: from the start, or on from the last checkpoint of its run.

    options: those of `block_options`; patience: seconds to wait for another process that trains it.
    Returns whether there was anything to do: a finished run is left alone. InputError where it was
    begun with other options.
    """
    run = RunFolder(block.run)
    if run.is_finished:  # also on a disk that may not be written
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
        start(scene, options, device, run, progress=progress)
    return True


def _check_same(run, options):
    for name, there, here in differences(run.read_options(), options):
        if name != MOVES:
            raise InputError(f"{run.path}: was begun with {name} {there}, and block.json has "
                             f"{here}; put that back, or remove the run")
