"""Gaussians as OpenUSD, a ParticleField3DGaussianSplat of version 26.03, which usd-core writes.

Scales are standard deviations, opacities 0 to 1, and harmonics as in a PLY, the constant first. The
prim with the gaussians adds the origin of their positions, and another one above it turns all so
that what is up becomes z, the up axis of the stage. Comments are in the layer's custom data.

Such files are not read: a scene in USD may refer to any other file of the machine, and its parts
have transforms of all kinds.
"""

import shutil
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import scipy

from clsplat.errors import InputError
from clsplat.gaussians import Gaussians
from clsplat.io.atomic import replacing
from clsplat.io.models import values as stored
from clsplat.io.models.values import Notes

ROOT, NAME = "/Upright", "/Upright/Gaussians"


def write_usd(path: Path, gaussians: Gaussians, notes: Notes) -> None:
    """Write gaussians as .usda (text), .usdc (binary) or .usdz (that in a package); see
    `models.write_model`. InputError without usd-core."""
    try:
        from pxr import Gf, Sdf, Usd, UsdGeom, UsdUtils, UsdVol, Vt
    except ImportError:
        raise InputError(f"{path}: OpenUSD needs usd-core; `pip install usd-core`") from None
    rows, origin = stored.stored_rows(gaussians)
    single = {name: np.ascontiguousarray(values, np.float32) for name, values in rows.items()}
    scales = stored.scales_of(single["log_scales"])
    xyzw = np.ascontiguousarray(np.roll(stored.unit(single["quaternions"]), -1, axis=1), np.float32)
    harmonics = np.concatenate([single["sh_constant"][:, None], single["sh_rest"]], axis=1)

    stage = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    stage.GetRootLayer().customLayerData = {"clsplat": Vt.StringArray(notes.lines)}
    root = UsdGeom.Xform.Define(stage, ROOT)
    stage.SetDefaultPrim(root.GetPrim())
    if notes.up is not None:
        turn, _ = scipy.spatial.transform.Rotation.align_vectors([(0.0, 0.0, 1.0)], [notes.up])
        x, y, z, w = turn.as_quat().tolist()
        root.AddOrientOp(UsdGeom.XformOp.PrecisionDouble).Set(Gf.Quatd(w, x, y, z))
    field = UsdVol.ParticleField3DGaussianSplat.Define(stage, NAME)
    UsdGeom.Xformable(field).AddTranslateOp().Set(Gf.Vec3d(*origin.tolist()))
    attributes: dict[str, Any] = {
        "positions": Vt.Vec3fArray.FromNumpy(single["positions"]),
        "orientations": Vt.QuatfArray.FromNumpy(xyzw),
        "scales": Vt.Vec3fArray.FromNumpy(scales),
        "opacities": Vt.FloatArray.FromNumpy(scipy.special.expit(single["opacity_logits"]).astype(np.float32)),
        "radiance:sphericalHarmonicsDegree": gaussians.sh_degree,
        "radiance:sphericalHarmonicsCoefficients": Vt.Vec3fArray.FromNumpy(harmonics.reshape(-1, 3)),
        "extent": Vt.Vec3fArray.FromNumpy(_extent(single["positions"], scales)),
    }
    for name, value in attributes.items():
        field.GetPrim().GetAttribute(name).Set(value)

    with TemporaryDirectory() as folder:
        packed = path.suffix.lower() == ".usdz"
        made = Path(folder) / ("model.usdc" if packed else path.name)
        if not stage.GetRootLayer().Export(str(made)):
            raise InputError(f"{path}: usd-core cannot write it")
        if packed:
            package = made.with_suffix(".usdz")
            UsdUtils.CreateNewUsdzPackage(Sdf.AssetPath(str(made)), str(package))
            made = package
        with replacing(path) as file, open(made, "rb") as content:
            shutil.copyfileobj(content, file)


def _extent(positions: np.ndarray, scales: np.ndarray) -> np.ndarray:
    """float32[2, 3]: the least and the largest corner of what is within three deviations."""
    if not len(positions):
        return np.zeros((2, 3), np.float32)
    reach = 3 * scales.max(axis=1, keepdims=True)
    return np.stack([(positions - reach).min(axis=0), (positions + reach).max(axis=0)])
