"""Models in other formats than PLY, and clouds of points, under fuzz."""

import numpy as np

from clsplat.georeference import Georeference
from clsplat.io.models.formats import read_model, write_model
from clsplat.io.models.gltf_spz import write_spz_glb
from tests.adversarial.fuzz.reader import Reader, check, gaussians_like
from tests.data.layouts import write_ply

GEOREFERENCE = Georeference("EPSG:32632", (5e5, 5.3e6, 200.0), "made", 0.1)
SIZES = ((6, 0), (300, 3))  # gaussians and degree of each seed


def _model(suffix):
    """The reader of a format, whose seeds are one file each."""
    def make(folder):
        for number, (count, degree) in enumerate(SIZES):
            seed = folder / str(number)
            seed.mkdir()
            georeference = GEOREFERENCE if number and suffix in (".las", ".laz") else None
            write_model(seed / f"model{suffix}", gaussians_like(count, degree).located(
                np.array([2.0, 3.0, 4.0]) * number), ("made",), np.array([0.0, 0.0, 1.0]),
                georeference)
            yield seed

    def read(folder):
        check(read_model(folder / f"model{suffix}"))
    return Reader(make, read, files=(suffix,))


def _tiles(folder):
    for number, (count, degree) in enumerate(SIZES):
        seed = folder / str(number)
        seed.mkdir()
        write_spz_glb(seed / "model.glb", gaussians_like(count, degree))
        yield seed


def _clouds(folder):
    random = np.random.default_rng(0)
    for number, offset in enumerate((0.0, 3e6)):
        seed = folder / str(number)
        seed.mkdir()
        colours = random.integers(0, 256, (9, 3), dtype=np.uint8)
        write_ply(seed / "model.ply", random.normal(size=(9, 3)) + offset,
                  colours if number else None)
        yield seed


def _cloud(folder):
    check(read_model(folder / "model.ply"))


READERS = {
    **{suffix[1:]: _model(suffix) for suffix in (
        ".compressed.ply", ".splat", ".spz", ".sog", ".glb", ".las", ".laz")},
    "spz.glb": Reader(_tiles, lambda folder: check(read_model(folder / "model.glb")),
                      files=(".glb",)),
    "cloud": Reader(_clouds, _cloud, files=(".ply",)),
}
