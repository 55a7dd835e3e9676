"""`clsplat.evaluate`: how well a model renders the photos of a scene."""

from dataclasses import dataclass
from typing import Any

from clsplat.api.device import best_device
from clsplat.device import Device as OpenedDevice
from clsplat.errors import InputError
from clsplat.evaluation.views import evaluate_views
from clsplat.gaussians import Gaussians
from clsplat.rendering.slabs import open_model
from clsplat.report.notebook import table
from clsplat.scene import Scene


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

    def _repr_html_(self) -> str:
        return table({"held-out views": str(self.views),
                      "PSNR": f"{self.psnr:.2f} dB ({self.psnr_cc:.2f} after the colour fit)",
                      "SSIM": f"{self.ssim:.4f} ({self.ssim_cc:.4f} after the colour fit)"})


def score_of(result: dict[str, Any]) -> Score:
    """A Score of what the evaluation of views returned."""
    return Score(result["views"], result["psnr"], result["ssim"], result["psnr_cc"],
                 result["ssim_cc"], tuple(result["per_view"]))


def evaluate(model: Gaussians, scene: Scene, *, device: OpenedDevice | None = None,
             test_every: int = 8, near: float | None = None, antialiased: bool = False,
             background: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Score:
    """Compare renders of a model with the held-out photos of a scene.

    Parameters
    ----------
    model : the gaussians, with the scene's offset.
    scene : its views are rendered at the size that their cameras have; see `Scene.reduced`.
    device : an open device; None: the best that works.
    test_every : every so-many-th view by name is held out; 0: all views are compared.
    near, antialiased, background : as for `clsplat.render`.

    Returns
    -------
    The Score.

    Raises
    ------
    clsplat.ClsplatError : where no view is held out, or a photo cannot be read.
    """
    views = scene.split(test_every)[1] if test_every else scene.views
    if not views:
        raise InputError(f"{scene.name}: no view is held out; use another test_every")
    if (model.offset != scene.offset).any():
        model = model.moved(scene.offset)
    renderer, rows = open_model(device or best_device(), model, near or scene.near_plane,
                                antialiased, background)
    return score_of(evaluate_views(renderer, rows, model.sh_degree, views))
