"""Trainings of two checkouts in turns: their seconds, and whether they end in the same bytes.

    python -m tools.studies.beside OTHER SCENE ... [--turns 4] [-- FLAGS of clsplat train]

Each turn is a seed, and which checkout comes first alternates. A first training of each, which
compiles the kernels, does not count. A JSON line is printed for each pair: `train` and `process`
are seconds of this checkout and of OTHER, `same` whether the gaussians are equal to the byte.
"""

import argparse
import hashlib
import json
import sys
import tempfile
from pathlib import Path

from clsplat.io.models.ply import read_ply
from clsplat.io.runs.run import RunFolder
from tools.studies.study import flags_after, timed_training

THIS = Path(__file__).resolve().parents[2]


def trained(checkout, scene, seed, flags):
    """(seconds of training, seconds of the process, digest of the gaussians) of a training."""
    with tempfile.TemporaryDirectory() as folder:
        run = Path(folder) / "run"
        process = timed_training(scene, run, ["--seed", str(seed), *flags], checkout)
        evaluation = [each for each in RunFolder(run).records() if each["event"] == "eval"][-1]
        model = read_ply(run / "point_cloud.ply")
        digest = hashlib.sha256(b"".join(each.tobytes() for each in model.rows.values()))
        return evaluation["train_seconds"], round(process, 2), digest.hexdigest()


def main(argv):
    """Print a line for each scene and turn."""
    words, flags = flags_after(argv)
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("other", type=Path, help="another checkout of clsplat")
    parser.add_argument("scenes", type=Path, nargs="+", metavar="SCENE")
    parser.add_argument("--turns", type=int, default=4)
    options = parser.parse_args(words)
    checkouts = [THIS, options.other]
    for scene in options.scenes:
        for checkout in checkouts:
            trained(checkout, scene, 0, flags)
        for turn in range(options.turns):
            order = checkouts[::-1] if turn % 2 else checkouts
            found = {checkout: trained(checkout, scene, turn, flags) for checkout in order}
            train, process, digests = zip(*(found[checkout] for checkout in checkouts))
            print(
                json.dumps(
                    {
                        "scene": scene.name,
                        "seed": turn,
                        "train": train,
                        "process": process,
                        "same": digests[0] == digests[1],
                    }
                ),
                flush=True,
            )


if __name__ == "__main__":
    main(sys.argv[1:])
