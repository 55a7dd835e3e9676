import numpy as np
import pytest

from clsplat.apps import edit
from clsplat.apps.edit import seen_by
from clsplat.camera import Camera
from clsplat.errors import InputError
from clsplat.scene import View
from tests.data.cloud import cloud


def views():
    """From the left and from the right, and a third that looks away."""
    places = (((-5, 0, 0), (0, 0, 0)), ((5, 0, 0), (0, 0, 0)), ((5, 0, 0), (10, 0, 0)))
    return [View(str(number), Camera.looking_at(target, place, width=64, height=48), b"")
            for number, (place, target) in enumerate(places)]


def test_what_stands_behind_a_wall_is_not_seen(float_device):
    model = cloud(3)
    model.rows["positions"][:] = [[0, 0, 0], [-1, 0, 0], [0, 3000, 0]]  # wall, in front, nowhere
    model.rows["log_scales"][:] = np.log([[0.01, 4, 4], [0.1, 0.1, 0.1], [0.1, 0.1, 0.1]])
    model.rows["quaternions"][:] = [1, 0, 0, 0]
    model.rows["opacity_logits"][:] = 9
    layers = [model.rows[name][:1].repeat(4, axis=0) for name in model.rows]
    walls = {name: np.concatenate([rows, layer])  # one lets 1 % through
             for (name, rows), layer in zip(model.rows.items(), layers)}
    count = seen_by(float_device, type(model)(walls, 3), views(), near=0.01)
    assert count[1] == 1 and count[2] == 0 and count[0] >= 1


def test_a_model_that_is_too_large(float_device, monkeypatch):
    monkeypatch.setattr(edit, "gaussian_limit", lambda *_: 2)
    with pytest.raises(InputError, match="3 gaussians are more than .* crop the model first"):
        seen_by(float_device, cloud(3), views(), near=0.01)
