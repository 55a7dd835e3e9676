"""Packs a scene into one .npz, for machines without pycolmap; a ground truth goes beside it.

Usage: python -m tools.pack SCENE OUT.npz [DOWNSCALE]
"""

import shutil
import sys
from pathlib import Path

from clsplat.evaluate.floaters import geometry_path
from clsplat.io.packed import write_packed
from clsplat.io.scenes import read_scene


def main(argv):
    scene, out, *downscale = argv
    truth = geometry_path(Path(scene))
    write_packed(read_scene(scene), out, float(downscale[0]) if downscale else 1)
    if truth.is_file():
        shutil.copyfile(truth, geometry_path(Path(out)))


if __name__ == "__main__":
    main(sys.argv[1:])
