import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.special import expit, logit

from clsplat.api.renderer import render
from clsplat.camera import Camera
from clsplat.edit.decimate import decimated
from clsplat.edit.select import selected
from clsplat.evaluation.metrics import psnr
from clsplat.gaussians import Gaussians
from tests.data.cloud import cloud


def covariances(model):
    axes = (
        Rotation.from_quat(model.quaternions[:, [1, 2, 3, 0]]).as_matrix()
        * np.exp(model.log_scales.astype(np.float64))[:, None]
    )
    return axes @ axes.transpose(0, 2, 1)


def test_two_become_one_with_their_moments():
    model = cloud(2)
    sigmas = np.sort(np.exp(model.log_scales.astype(np.float64)), axis=1)
    masses = expit(model.opacity_logits.astype(np.float64)) * sigmas[:, 1] * sigmas[:, 2]
    share = masses / masses.sum()
    one = decimated(model, 1)
    mean = share @ model.positions
    away = model.positions - mean
    expected = np.einsum("n,nij->ij", share, covariances(model) + away[:, :, None] * away[:, None])
    assert one.count == 1 and np.allclose(one.positions[0], mean, atol=1e-5)
    assert np.allclose(covariances(one)[0], expected, atol=1e-6)
    assert np.allclose(one.sh_rest[0], np.einsum("n,nkc->kc", share, model.sh_rest), atol=1e-6)
    largest = np.sqrt(np.linalg.eigvalsh(expected)[1:].prod())
    assert expit(one.opacity_logits[0]) == pytest.approx(min(0.99, masses.sum() / largest), 1e-4)


def test_the_cheapest_pairs_are_merged_and_the_rest_stays():
    model = cloud(40, size=0.02)
    copies = Gaussians({name: np.concatenate([rows, rows[:5]]) for name, rows in model.rows.items()}, 3)
    copies.rows["opacity_logits"][-5:] = copies.rows["opacity_logits"][:5] = logit(0.2)
    fewer = decimated(copies, 40)
    assert fewer.count == 40
    untouched = [name for name in model.rows if (fewer.rows[name][5:] == model.rows[name][5:]).all()]
    assert untouched == list(model.rows), "only the five pairs of copies changed"
    assert np.allclose(expit(fewer.opacity_logits[:5]), 0.4, atol=1e-5)
    assert np.allclose(covariances(fewer), covariances(model), rtol=1e-3, atol=1e-8)


@pytest.mark.parametrize("count", [1, 59, 1000])
@pytest.mark.parametrize("at_one_place", [False, True])
def test_counts(count, at_one_place):
    calls = []
    model = cloud()
    if at_one_place:  # and without sizes
        for name, value in (("positions", 0), ("log_scales", -60), ("opacity_logits", -200), ("quaternions", 0)):
            model.rows[name][:] = value
    fewer = decimated(model, count, progress=lambda done, total: calls.append((done, total)))
    assert fewer.count == min(count, 60)
    assert all(np.isfinite(rows).all() for rows in fewer.rows.values())
    assert not calls if count >= 60 else calls[-1] == (60 - count, 60 - count)


def test_it_looks_almost_the_same(float_device):
    model = cloud(400, size=0.08)
    model.rows["sh_constant"][:] = np.sin(3 * model.positions)  # neighbours look alike
    model.rows["sh_rest"][:] *= 0.1
    camera = Camera.looking_at((0, 0, 0), (0, -3, 1), width=96, height=64, degrees=40)
    whole = render(model, camera, device=float_device)

    def score(fewer):
        return psnr(np.clip(render(fewer, camera, device=float_device), 0, 1), np.clip(whole, 0, 1))

    largest = np.argsort(model.opacity_logits + model.log_scales.sum(axis=1))[-200:]
    chosen = selected(model, np.isin(np.arange(400), largest))
    assert score(decimated(model, 200)) > max(25, score(chosen) + 3)
