"""OpenUSD: what its own library reads is the model, and its validators find no fault."""

import sys

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from clsplat.gaussians import Gaussians
from clsplat.io.models.formats import read_model, write_model
from tests.io.models.test_formats import model, opacity, turns, world
from tests.io.models.test_ply import UTM
from tests.refusals import refused

SUFFIXES = (".usda", ".usdc", ".usdz")
UP = np.array([0.0, 0.6, 0.8])


@pytest.fixture
def pxr():
    return pytest.importorskip("pxr", reason="the extra [usd] is not installed")


def read(path, degree):
    """The model of a file, in original coordinates, and the rotation above it."""
    from pxr import Usd, UsdGeom

    stage = Usd.Stage.Open(str(path))
    (prim,) = (each for each in stage.Traverse() if each.GetTypeName() == "ParticleField3DGaussianSplat")
    value = {name: prim.GetAttribute(name).Get() for name in prim.GetPropertyNames()}
    assert value["radiance:sphericalHarmonicsDegree"] == degree
    harmonics = np.array(value["radiance:sphericalHarmonicsCoefficients"]).reshape(-1, (degree + 1) ** 2, 3)
    wxyz = np.array([(q.GetReal(), *q.GetImaginary()) for q in value["orientations"]], np.float32).reshape(-1, 4)
    alpha = np.array(value["opacities"], np.float64)
    own, above = (
        np.array(UsdGeom.Xformable(each).GetLocalTransformation())  # of row vectors
        for each in (prim, prim.GetParent())
    )
    assert np.array_equal(own[:3, :3], np.eye(3)) and np.array_equal(above[3], [0, 0, 0, 1])
    low, high = value["extent"]
    rows = {
        "positions": np.array(value["positions"]),
        "log_scales": np.log(value["scales"]),
        "quaternions": wxyz,
        "opacity_logits": np.log(alpha / (1 - alpha)),
        "sh_constant": harmonics[:, 0],
        "sh_rest": harmonics[:, 1:],
    }
    assert ((rows["positions"] > low) & (rows["positions"] < high)).all()
    assert UsdGeom.GetStageUpAxis(stage) == "Z" and UsdGeom.GetStageMetersPerUnit(stage) == 1
    return (
        Gaussians({name: values.astype(np.float32) for name, values in rows.items()}, degree, own[3, :3]),
        above[:3, :3].T,
        stage.GetRootLayer().customLayerData,
    )


@pytest.mark.parametrize("suffix", SUFFIXES)
@pytest.mark.parametrize("degree, offset", [(3, UTM), (1, (0, 0, 0)), (0, (0, 0, 0))])
def test_usd_core_reads_the_model(tmp_path, pxr, suffix, degree, offset):
    path, expected = tmp_path / f"a{suffix}", model(200, degree, offset)
    write_model(path, expected, ["SplatRenderMode: mip"], up=UP)
    found, turn, notes = read(path, degree)
    assert np.abs(world(found) - world(expected)).max() < 1e-6
    assert np.abs(found.log_scales - expected.log_scales).max() < 1e-5
    assert turns(found.quaternions, expected.quaternions).max() < 1e-3
    assert np.abs(opacity(found) - opacity(expected)).max() < 1e-6
    assert np.array_equal(found.sh_constant, expected.sh_constant)
    assert np.array_equal(found.sh_rest, expected.sh_rest)
    assert np.allclose(turn @ UP, [0, 0, 1]) and Rotation.from_matrix(turn).magnitude() > 0.5
    assert "SplatRenderMode: mip" in notes["clsplat"]


@pytest.mark.parametrize("suffix", SUFFIXES)
@pytest.mark.parametrize("count", [0, 40])
def test_validators_find_no_fault(tmp_path, pxr, suffix, count):
    from pxr import Usd, UsdValidation

    write_model(tmp_path / f"a{suffix}", model(count), up=UP)
    stage = Usd.Stage.Open(str(tmp_path / f"a{suffix}"))
    validators = UsdValidation.ValidationRegistry().GetOrLoadAllValidators()
    found = UsdValidation.ValidationContext(validators).Validate(stage)
    assert len(validators) > 10 and not [each.GetErrorAsString() for each in found]


def test_the_same_model_gives_the_same_bytes(tmp_path, pxr):
    for name in ("a.usdz", "b.usdz"):
        write_model(tmp_path / name, model(40))
    assert (tmp_path / "a.usdz").read_bytes() == (tmp_path / "b.usdz").read_bytes()


def test_what_is_not_done_is_said(tmp_path, monkeypatch):
    (tmp_path / "a.usda").write_text("#usda 1.0\n")
    refused(
        lambda: read_model(tmp_path / "a.usda"), "a.usda: OpenUSD, text, which is not read", "give the model as .ply"
    )
    monkeypatch.setitem(sys.modules, "pxr", None)
    refused(
        lambda: write_model(tmp_path / "b.usdz", model(3)), "b.usdz: OpenUSD needs usd-core", "pip install usd-core"
    )
    assert [path.name for path in tmp_path.iterdir()] == ["a.usda"]
