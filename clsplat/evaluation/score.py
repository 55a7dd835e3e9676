"""`clsplat.Score`: the result of an evaluation on held-out views."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any


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
        """The Score from the result of `evaluate_views`.

        Parameters
        ----------
        result : has the keys of the attributes, and others.
        """
        known = {field.name: result[field.name] for field in fields(cls) if field.name in result}
        return cls(**{**known, "per_view": tuple(result["per_view"])})

    def __repr__(self) -> str:
        return (f"<clsplat.Score of {self.views} views: PSNR {self.psnr:.2f} dB "
                f"({self.psnr_cc:.2f} after the colour fit), SSIM {self.ssim:.4f}>")

    def _repr_html_(self) -> str:
        from clsplat.report.notebook import table

        rows = {"held-out views": str(self.views),
                "PSNR": f"{self.psnr:.2f} dB ({self.psnr_cc:.2f} after the colour fit)",
                "SSIM": f"{self.ssim:.4f} ({self.ssim_cc:.4f} after the colour fit)"}
        for name, plain, fitted in (("FLIP", self.flip, self.flip_cc),
                                    ("LPIPS", self.lpips, self.lpips_cc)):
            if plain is not None and fitted is not None:
                rows[name] = f"{plain:.4f} ({fitted:.4f} after the colour fit), lower is better"
        if self.psnr_aligned is not None:
            rows["PSNR from aligned poses"] = (
                f"{self.psnr_aligned:.2f} dB ({self.psnr_cc_aligned:.2f} after the colour fit)")
        return table(rows)
