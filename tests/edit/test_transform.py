import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from clsplat.api.renderer import render
from clsplat.camera import Camera
from clsplat.edit.select import merged
from clsplat.edit.transform import harmonics, rotated, transformed
from clsplat.errors import InputError
from clsplat.gaussians import Gaussians
from tests.data.cloud import cloud
from tests.reference.project import harmonics as reference


@pytest.mark.parametrize("scale", [1.0, 2.5])
@pytest.mark.one_in(3)
def test_it_looks_the_same_from_a_camera_that_moved_along(float_device, scale):
    """The whole chain: positions, covariances and harmonics of degree 3."""
    model = cloud(offset=(10.0, -20.0, 5.0))
    camera = Camera.looking_at((10.1, -20, 5), (12.5, -21.5, 6), width=96, height=64, degrees=50)
    rotation = Rotation.from_euler("zyx", (40, -100, 25), degrees=True).as_matrix()
    translation = np.array([3.0, 40.0, -7.0])
    moved = transformed(model, scale, rotation, translation)
    along = Camera(
        camera.width,
        camera.height,
        camera.focal,
        camera.centre,
        camera.rotation @ rotation.T,
        scale * camera.translation - camera.rotation @ rotation.T @ translation,
    )
    before = render(model, camera, device=float_device)
    after = render(moved, along, device=float_device)
    assert before.std() > 0.1 and np.abs(before - after).max() < 2e-3
    unturned = transformed(model.with_sh_degree(0), scale, rotation, translation)
    assert np.abs(before - render(unturned, along, device=float_device)).max() > 0.05


def test_coordinates():
    model = cloud(offset=(500_000.0, 4_000_000.0, 100.0))
    turn = Rotation.from_euler("z", 90, degrees=True).as_matrix()
    moved = transformed(model, 2.0, turn, (1.0, 2.0, 3.0))
    x, y, z = (model.positions.astype(np.float64) + model.offset).T
    expected = np.stack([-2 * y + 1, 2 * x + 2, 2 * z + 3], axis=1)
    assert np.abs(moved.positions + moved.offset - expected).max() < 1e-5
    assert np.abs(moved.positions).max() < 10, "local coordinates stay small"
    assert np.allclose(moved.log_scales, model.log_scales + np.log(2), atol=1e-6)
    assert (moved.opacity_logits == model.opacity_logits).all()
    same = transformed(model)
    assert all((same.rows[name] == values).all() for name, values in model.rows.items())


@pytest.mark.parametrize("bands", [0, 3, 8, 15])
def test_a_rotated_function_has_in_a_rotated_direction_its_old_value(bands):
    turn = Rotation.random(random_state=5).as_matrix()
    rest = np.random.default_rng(0).normal(size=(4, bands, 3)).astype(np.float32)
    d = np.random.default_rng(1).normal(size=(50, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    before, after = harmonics(d)[:, :bands], harmonics(d @ turn.T)[:, :bands]
    found = rotated(rest, turn)
    assert found.dtype == np.float32 and found.shape == rest.shape
    assert np.allclose(np.einsum("dk,nkc->dnc", after, found), np.einsum("dk,nkc->dnc", before, rest), atol=1e-5)
    full = reference(d, 3)[0][:, 1 : bands + 1]
    assert np.allclose(before, full, atol=1e-12)


@pytest.mark.parametrize(
    "scale, translation", [(1e38, (0, 0, 0)), (1e-300, (0, 0, 0)), (1.0, (0, -1e39, 0)), (1e200, (1e300, 0, 0))]
)
@pytest.mark.filterwarnings("error")
def test_what_single_precision_does_not_hold_is_refused(scale, translation):
    points = np.random.default_rng(0).normal(size=(50, 3)) * 9
    model = Gaussians.from_points(points, np.zeros((50, 3), np.uint8), 1)
    with pytest.raises(InputError, match="beyond 1e-38 to 3e.38|finite"):
        transformed(model, scale, np.eye(3), translation)
    assert np.isfinite(transformed(model, 1e9, None, (1e12, 0, 0)).positions).all()


def test_models_are_merged_where_they_stand():
    one, other = cloud(5, 1, offset=(100.0, 0, 0)), cloud(7, 3, seed=1, offset=(103.0, 2, 1))
    both = merged([one, other])
    assert both.count == 12 and both.sh_degree == 3 and (both.offset == one.offset).all()
    world = np.concatenate([model.positions + model.offset for model in (one, other)])
    assert np.allclose(both.positions + both.offset, world, atol=1e-5)
    assert (both.sh_rest[5:] == other.sh_rest).all() and (both.sh_rest[:5, 3:] == 0).all()
    with pytest.raises(InputError, match="too far apart"):
        merged([one, cloud(4, size=1e-3, offset=(5e6, 0, 0))])
