"""A reader under fuzz: how its valid files are made, and how a mutated one is read."""

import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from clsplat.gaussians import Gaussians
from clsplat.io.photos.views import read_photo
from clsplat.io.scenes.read import fingerprint


@dataclass(frozen=True)
class Reader:
    """make: called with an empty folder, yields those below it that are seeds; read: called with a
    seed's folder; text: whether its files are lines of fields; files: suffixes of those mutated."""

    make: Callable
    read: Callable
    text: bool = False
    files: tuple[str, ...] = ("",)

    def seeds(self):
        """List of {relative path: bytes}, the same whenever it is called."""
        with tempfile.TemporaryDirectory(prefix="clsplat-fuzz-") as folder:
            return [{file.relative_to(seed).as_posix(): file.read_bytes()
                     for file in sorted(seed.rglob("*")) if file.is_file()}
                    for seed in self.make(Path(folder))]


def usable(scene):
    """A scene that was accepted can be trained."""
    assert scene.views and len(scene.points) == len(scene.colours)
    assert np.isfinite(scene.points).all() and np.isfinite(scene.offset).all()
    assert 0 < scene.extent < np.inf and scene.near_plane > 0
    for view in scene.views:
        camera = view.camera
        numbers = (camera.width, camera.height, *camera.focal, *camera.centre)
        assert np.isfinite(numbers).all() and np.isfinite(camera.position).all()
        camera.reduced(2)
        assert read_photo(view).shape == (camera.height, camera.width, 3)
    assert len(fingerprint(scene)) == 64
    if scene.observations is not None:
        assert scene.observations.min() >= 0
        assert (scene.observations.max(axis=0) < (len(scene.points), len(scene.views))).all()


def gaussians_like(count, degree, seed=0):
    """Gaussians with random values in all rows."""
    random = np.random.default_rng(seed)
    made = Gaussians.from_points(random.normal(size=(count, 3)), random.integers(
        0, 256, (count, 3), dtype=np.uint8), degree)
    rows = {**made.rows, "anchors": made.positions + 1, "max_offsets": made.opacity_logits + 9}
    return Gaussians(rows, degree)


def check(gaussians):
    """Gaussians that were accepted can be rendered."""
    for values in gaussians.rows.values():
        assert values.dtype in (np.float32, np.float64) and len(values) == gaussians.count
        assert np.isfinite(values).all()
