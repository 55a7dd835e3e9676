"""Makes a large set of photos of a small one: crops, half of them turned, with another gain and
noise, each 3200 x 2400 pixels. `python -m tools.studies.many_photos PHOTOS OUT`"""

import sys
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import numpy as np
import scipy

from clsplat.io.photos.images import read_image, write_image

CROPS = 6  # of each photo
WIDTH, HEIGHT, QUALITY = 3200, 2400, 90
NOISE = 5.0  # of 255


def make(photo: Path, output: Path, number: int) -> None:
    """Write one crop of a photo."""
    rng = np.random.default_rng([number, *photo.stem.encode()])
    pixels = read_image(photo)
    height, width = (int(side * rng.uniform(0.8, 1)) for side in pixels.shape[:2])
    y, x = (rng.integers(0, whole - side + 1) for whole, side in zip(pixels.shape, (height, width)))
    crop = pixels[y : y + height, x : x + width][:: (-1) ** number, :: (-1) ** number]
    enlarged = scipy.ndimage.zoom(crop, (HEIGHT / height, WIDTH / width, 1), order=1)
    values = enlarged * rng.uniform(0.9, 1.1) + rng.normal(0, NOISE, (HEIGHT, WIDTH, 1))
    write_image(output / f"{number}_{photo.stem}.jpg", np.clip(values, 0, 255).round().astype(np.uint8), QUALITY)


def main() -> None:
    """Make the set."""
    source, output = map(Path, sys.argv[1:])
    output.mkdir(parents=True)
    with ProcessPoolExecutor() as pool:
        done = [
            pool.submit(make, photo, output, number) for number in range(CROPS) for photo in sorted(source.iterdir())
        ]
    for each in done:
        each.result()


if __name__ == "__main__":
    main()
