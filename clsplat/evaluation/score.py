"""`clsplat.Score`: the result of an evaluation on held-out views."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Score:
    """Means over views; `_cc` after a quadratic fit of each render's colours to its photo.

    Attributes
    ----------
    views : how many views were rendered.
    psnr, psnr_cc : dB.
    ssim, ssim_cc : 0 to 1.
    per_view : a dict for each view, with its `name` and the four scores.
    """

    views: int
    psnr: float
    ssim: float
    psnr_cc: float
    ssim_cc: float
    per_view: tuple[dict[str, Any], ...] = ()

    @classmethod
    def of(cls, result: dict[str, Any]) -> Score:
        """The Score from the result of `evaluate_views`.

        Parameters
        ----------
        result : has the keys of the attributes, and others.
        """
        return cls(result["views"], result["psnr"], result["ssim"], result["psnr_cc"],
                   result["ssim_cc"], tuple(result["per_view"]))

    def _repr_html_(self) -> str:
        from clsplat.report.notebook import table

        return table({"held-out views": str(self.views),
                      "PSNR": f"{self.psnr:.2f} dB ({self.psnr_cc:.2f} after the colour fit)",
                      "SSIM": f"{self.ssim:.4f} ({self.ssim_cc:.4f} after the colour fit)"})
