"""Packs a scene into one .npz, for machines without pycolmap.

Usage: python -m tools.pack SCENE OUT.npz [DOWNSCALE]
"""

import sys

from clsplat.io.packed import write_packed
from clsplat.io.scenes import read_scene


def main(argv):
    scene, out, *downscale = argv
    write_packed(read_scene(scene), out, float(downscale[0]) if downscale else 1)


if __name__ == "__main__":
    main(sys.argv[1:])
