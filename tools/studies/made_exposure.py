"""Make a copy of the sample city whose photos have a known tone curve and a known exposure each.

    python -m tools.studies.made_exposure OUT [--bends 0 0.6] [--drift 0.4]
    python -m tools.studies.response RUNS OUT --exposure on --tone on --offsets 3 --downscale 4
        --iterations 2000 --rate 1e-2

The light of a photo, by the inverse of the curve, is multiplied by the exponential of a sine along
the photos, whose amplitude is --drift, and the curve is applied again. A response that contains
that curve describes it without an error; a colour transform alone does not.
"""

import argparse
import shutil
from pathlib import Path

import numpy as np

from clsplat.camera import Camera
from clsplat.io.photos.images import read_image, write_image
from clsplat.response import Response

CITY = Path(__file__).resolve().parents[2] / "data_samples" / "city"
WAVES = 1.5  # of the sine


def main(argv=None):
    """Write the scene."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("out", type=Path)
    parser.add_argument("--bends", type=float, nargs=2, default=[0.0, 0.6])
    parser.add_argument("--drift", type=float, default=0.4)
    options = parser.parse_args(argv)
    shutil.copytree(CITY, options.out)
    paths = sorted((options.out / "images").iterdir())
    for number, path in enumerate(paths):
        gain = np.exp(options.drift * np.sin(2 * np.pi * WAVES * number / len(paths) + 0.5))
        photo = read_image(path) / 255
        camera = Camera(*photo.shape[1::-1], (1, 1), (0, 0), np.eye(3), np.zeros(3))
        made = Response(gain * np.eye(3, 4), tone=np.array(options.bends)).applied(photo, camera)
        write_image(path, np.clip(made, 0, 1))


if __name__ == "__main__":
    main()
