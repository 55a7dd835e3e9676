import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from clsplat.edit.harmonics import harmonics, rotated, wigner


def directions(count=50, seed=1):
    vectors = np.random.default_rng(seed).normal(size=(count, 3))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def test_the_harmonics_are_those_of_mathematics():
    """Real harmonics from scipy's complex ones, with the Condon-Shortley phase as 3DGS has it."""
    special = pytest.importorskip("scipy.special")
    if not hasattr(special, "sph_harm_y"):
        pytest.skip("scipy has sph_harm_y from 1.15 on")
    d = directions()
    theta, phi = np.arccos(d[:, 2]), np.arctan2(d[:, 1], d[:, 0])
    expected = []
    for degree in (1, 2, 3):
        for order in range(-degree, degree + 1):
            value = special.sph_harm_y(degree, abs(order), theta, phi)
            part = value.imag if order < 0 else value.real
            expected.append(part * (np.sqrt(2) if order else 1))
    assert np.allclose(harmonics(d), np.transpose(expected), atol=1e-12)


@pytest.mark.parametrize("degree", [1, 2, 3])
def test_wigner_matrices(degree):
    band = slice(degree**2 - 1, (degree + 1) ** 2 - 1)
    one, other = Rotation.random(2, random_state=3).as_matrix()
    matrix = wigner(one, degree)
    assert np.allclose(matrix @ matrix.T, np.eye(2 * degree + 1), atol=1e-12)
    assert np.allclose(wigner(one @ other, degree), matrix @ wigner(other, degree), atol=1e-12)
    # a rotated function has, in a rotated direction, the value that it had before
    weights = np.random.default_rng(0).normal(size=2 * degree + 1)
    d = directions()
    assert np.allclose(harmonics(d @ one.T)[:, band] @ (matrix @ weights),
                       harmonics(d)[:, band] @ weights, atol=1e-12)


@pytest.mark.parametrize("bands", [0, 3, 8, 15])
def test_every_degree_of_a_model(bands):
    turn = Rotation.random(random_state=5).as_matrix()
    rest = np.random.default_rng(0).normal(size=(4, bands, 3)).astype(np.float32)
    d = directions()
    before, after = harmonics(d)[:, :bands], harmonics(d @ turn.T)[:, :bands]
    found = rotated(rest, turn)
    assert found.dtype == np.float32 and found.shape == rest.shape
    assert np.allclose(np.einsum("dk,nkc->dnc", after, found),
                       np.einsum("dk,nkc->dnc", before, rest), atol=1e-5)
