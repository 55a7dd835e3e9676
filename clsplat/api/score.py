"""`clsplat.evaluate` and `clsplat.Score`: how well a model renders the photos of a scene."""

from __future__ import annotations

from dataclasses import dataclass, fields
from os import PathLike
from typing import Any

from clsplat.api.device import opened_device
from clsplat.device import Device as OpenedDevice
from clsplat.errors import InputError
from clsplat.evaluation.views import depth_to_align, evaluate_views, final_metrics
from clsplat.gaussians import Gaussians
from clsplat.rendering.slabs import open_model
from clsplat.report.notebook import table
from clsplat.scene import Scene


@dataclass(frozen=True)
class Score:
    """Means over views; `_cc` after a quadratic fit of each render's colours to its photo.

    `_aligned` is from poses that were aligned with the photos, None where that was not asked for.

    Attributes
    ----------
    views : how many views were rendered.
    psnr, psnr_cc : dB.
    ssim, ssim_cc : 0 to 1.
    per_view : a dict for each view, with its `name` and all scores.
    flip, flip_cc : 0 to 1, lower is better (Andersson et al. 2020).
    lpips, lpips_cc : lower is better; None if no network was given.
    psnr_aligned, psnr_cc_aligned, ssim_aligned, ssim_cc_aligned : as without the suffix.
    flip_aligned, flip_cc_aligned, lpips_aligned, lpips_cc_aligned : as without the suffix.
    aligned_degrees : mean angle by which a view was turned.
    aligned_shift : mean distance by which a view was moved, as a share of the typical depth.
    exposure_weight : where the run learned exposures, the share of the interpolation between the
        training photos before and after in the exposure of held-out views; the rest is the mean of
        all. None: views are rendered as the model is.
    """

    views: int
    psnr: float
    ssim: float
    psnr_cc: float
    ssim_cc: float
    per_view: tuple[dict[str, Any], ...] = ()
    flip: float | None = None
    flip_cc: float | None = None
    lpips: float | None = None
    lpips_cc: float | None = None
    exposure_weight: float | None = None
    psnr_aligned: float | None = None
    psnr_cc_aligned: float | None = None
    ssim_aligned: float | None = None
    ssim_cc_aligned: float | None = None
    flip_aligned: float | None = None
    flip_cc_aligned: float | None = None
    lpips_aligned: float | None = None
    lpips_cc_aligned: float | None = None
    aligned_degrees: float | None = None
    aligned_shift: float | None = None

    @classmethod
    def of(cls, result: dict[str, Any]) -> Score:
        """The Score from the result of `evaluate_views`, which has other keys too."""
        known = {field.name: result[field.name] for field in fields(cls) if field.name in result}
        return cls(**{**known, "per_view": tuple(result["per_view"])})

    def __repr__(self) -> str:
        return (
            f"<clsplat.Score of {self.views} views: PSNR {self.psnr:.2f} dB "
            f"({self.psnr_cc:.2f} after the colour fit), SSIM {self.ssim:.4f}>"
        )

    def _repr_html_(self) -> str:
        rows = {"held-out views": str(self.views)}
        for name, plain, fitted, digits, unit in (
            ("PSNR", self.psnr, self.psnr_cc, 2, " dB"),
            ("SSIM", self.ssim, self.ssim_cc, 4, ""),
            ("FLIP, lower is better", self.flip, self.flip_cc, 4, ""),
            ("LPIPS, lower is better", self.lpips, self.lpips_cc, 4, ""),
            ("PSNR from aligned poses", self.psnr_aligned, self.psnr_cc_aligned, 2, " dB"),
        ):
            if plain is not None:
                rows[name] = f"{plain:.{digits}f}{unit} ({fitted:.{digits}f} after the colour fit)"
        return table(rows)


def evaluate(
    model: Gaussians,
    scene: Scene,
    *,
    device: OpenedDevice | None = None,
    test_every: int = 8,
    test_offset: int = 0,
    near: float | None = None,
    antialiased: bool = False,
    background: tuple[float, float, float] = (0.0, 0.0, 0.0),
    lpips: str | PathLike[str] | None = None,
    align: bool = False,
) -> Score:
    """Compare renders of a model with the held-out photos of a scene.

    Parameters
    ----------
    model : the gaussians, with the scene's offset.
    scene : the views, rendered at the size of their cameras; see `Scene.reduced`.
    device : an open device; None: the best one that works.
    test_every, test_offset : the views that are held out, as for `Scene.split`; test_every 0: all
        views are compared.
    near, antialiased, background : as for `clsplat.render`.
    lpips : an ONNX file with an LPIPS network, whose score is wanted too (see `clsplat eval`).
    align : whether the photos are also compared from poses that are aligned with them (see `clsplat
        eval --align`).

    Returns
    -------
    The Score.

    Raises
    ------
    clsplat.ClsplatError : if no view is held out, or a photo or the network cannot be read.
    """
    views = scene.split(test_every, test_offset)[1] if test_every else scene.views
    if not views:
        raise InputError(f"{scene.name}: no view is held out; use another test_every")
    renderer, rows = open_model(
        opened_device(device), model.moved(scene.offset), scene.near(near or 0), antialiased, background
    )
    return Score.of(
        evaluate_views(
            renderer,
            rows,
            model.sh_degree,
            views,
            metrics=final_metrics(lpips),
            align=depth_to_align(scene) if align else 0.0,
        )
    )
