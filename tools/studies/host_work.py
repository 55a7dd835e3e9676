"""The time of a city's work on the host: an exchange, a part and floaters; prints JSON lines.

    python -m tools.studies.host_work CITY/blocks/001 [--repeats 5] [--gaussians 500000]

The block and those with which it exchanges gaussians have come to their first exchange:
`clsplat block CITY/blocks/001 --until-exchange 1`, and so on. Nothing in the city changes but what
an exchange writes, which is the same each time. Floaters are those of gaussians that are drawn
around the surfaces of the made city that the blocks show; any other scene has none. The machine
should do nothing else.
"""

import argparse
import json
import resource
import time
from pathlib import Path

import numpy as np

from clsplat.city.block import block_options
from clsplat.city.exchange import exchange, lacking_blocks, other_blocks, write_part
from clsplat.errors import InputError
from clsplat.evaluation.floaters import floater_share, ground_truth
from clsplat.gaussians import Gaussians
from clsplat.io.runs.city import BlockFolder, CityFolder
from clsplat.io.runs.run import RunFolder
from clsplat.io.runs.scene_path import recorded_scene
from clsplat.io.scenes.read import read_scene
from clsplat.synth.geometry import sample
from tools.studies.evidence import outermost

AROUND = 0.05  # mean distance of gaussians from the surface, world units
MARGIN = 8.0  # of the ground around the city, world units


def main(argv):
    """Time each kind of work and print a line for it."""
    arguments = _parser().parse_args(argv)
    if arguments.repeats < 1 or arguments.gaussians < 1:
        raise InputError("--repeats and --gaussians: expect numbers of at least 1")
    block, run = BlockFolder(arguments.block), RunFolder(arguments.block / "run")
    others = other_blocks(block)
    if not run.has_checkpoint or lacking_blocks([block, *others], 1):
        raise InputError(f"{block.path}: this block and the others of its city have not come to "
                         "their first exchange; run `clsplat block` with --until-exchange 1 on "
                         "each of them")
    scene, options, saved = read_scene(block.path), block_options(block), run.load_checkpoint()
    _report("part", arguments.repeats, lambda: _part_again(block, scene, saved),
            gaussians=len(saved[0]["row.positions"]))
    _report("exchange", arguments.repeats,
            lambda: exchange(block, scene, others, options, 1, run), blocks=len(others))
    folder = CityFolder(block.path.absolute().parents[1])
    whole = read_scene(recorded_scene(folder.read(), folder.path))
    city = ground_truth(whole.path)
    if city is not None:
        cameras = [view.camera for view in whole.views]
        gaussians = _near_surfaces(city, whole, arguments.gaussians)
        _report("floaters", arguments.repeats,
                lambda: floater_share(city, gaussians, cameras, whole.offset),
                gaussians=gaussians.count, cameras=len(cameras), solids=len(city.bounds))


def _parser():
    made = argparse.ArgumentParser(description=__doc__,
                                   formatter_class=argparse.RawDescriptionHelpFormatter)
    made.add_argument("block", type=Path, help="folder of a block of a city")
    made.add_argument("--repeats", type=int, default=5, help="of each kind of work; default 5")
    made.add_argument("--gaussians", type=int, default=500_000,
                      help="whose floaters are counted; default 500000")
    return made


def _part_again(block, scene, saved):
    """Write the part of a block anew; the file that is there is replaced by the same bytes."""
    path = block.part(1)
    kept = path.rename(path.with_suffix(".kept"))
    try:
        write_part(block, scene, 1, saved)
    finally:
        if not path.exists():
            kept.rename(path)
        kept.unlink(missing_ok=True)


def _near_surfaces(city, scene, count):
    """Gaussians near the surfaces of a made city, a twentieth of them farther away."""
    rng = np.random.default_rng(0)
    points = sample(city, count, MARGIN, rng)
    away = rng.exponential(AROUND, (count, 1))
    away[:count // 20] = 3.0
    points += rng.normal(size=points.shape) * away
    return Gaussians.padded({"positions": (points - scene.offset).astype(np.float32),
                             "opacity_logits": rng.normal(size=count).astype(np.float32)})


def _report(work, repeats, call, **facts):
    """Print the quartiles of the seconds of a call, and the process's peak of memory so far."""
    seconds = []
    for _ in range(repeats):
        begin = time.perf_counter()
        call()
        seconds.append(time.perf_counter() - begin)
    low, median, high = np.percentile(seconds, (25, 50, 75)).round(3).tolist()
    print(json.dumps({
        "work": work, **facts, "repeats": repeats, "median_s": median, "quartiles_s": [low, high],
        "peak_mib": round(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)}), flush=True)


if __name__ == "__main__":
    outermost(main)
