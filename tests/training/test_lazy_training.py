"""A whole training with lazy dense Adam beside one whose rows all catch up after every step."""

import numpy as np
import pytest

from clsplat.device import Device
from clsplat.gaussians import LEARNED
from clsplat.io.runs.run import RunFolder
from clsplat.io.scenes.read import read_scene
from clsplat.optimise.adam import DeviceAdam
from clsplat.training.loop import Training
from clsplat.training.start.initialise import initial_gaussians
from clsplat.training.start.prepare import prepare
from tests.data.tiny_training import CITY, STILL, options_of


def rows_after(scene, options, device, folder):
    training = Training(scene, options, device, RunFolder.create(folder))
    training.clock.restart()
    while not training.finished():
        training.take_step()
    training.session.photos.close()
    return training.session.model.download().rows


@pytest.mark.nightly
def test_lazy_training_is_dense_training(item_device, tmp_path, monkeypatch):
    """In double precision, to 1e-5 of the movement in 130 steps with a growing degree: what
    an element of almost no gradient does, where epsilon counts, included."""
    if not item_device.capabilities["HAVE_DOUBLE"]:
        pytest.skip(f"{item_device.name} has no double precision")
    device = Device(item_device.handle, "double", form="item")
    scene, options = read_scene(CITY), options_of(**STILL, iterations=130)
    before = initial_gaussians(prepare(scene, options).scene, options).rows
    lazy = rows_after(scene, options, device, tmp_path / "lazy")
    advance = DeviceAdam.advance

    def eager(self, step, degree, rows, frozen, counts):
        advance(self, step, degree, rows, frozen, counts)
        lags.append((self.lag()["last_step"] != self.steps).mean())
        self._coast(rows(), frozen, None, True, step, degree, counts)  # not after a failed frame

    lags = []
    monkeypatch.setattr(DeviceAdam, "advance", eager)
    dense = rows_after(scene, options, device, tmp_path / "dense")
    assert np.mean(lags) > 0.1
    for field in LEARNED:
        moved = np.linalg.norm(dense[field.name] - before[field.name])
        off = np.linalg.norm(lazy[field.name] - dense[field.name])
        assert 0 < moved and off <= 1e-5 * moved, (field.name, off / moved)
