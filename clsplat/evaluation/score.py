"""The result of an evaluation on held-out views."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from typing_extensions import Self


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
    def of(cls, result: dict[str, Any]) -> Self:
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
