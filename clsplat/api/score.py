"""`clsplat.evaluate` and `clsplat.Score`: how well a model renders the photos of a scene."""

from os import PathLike

from clsplat.api.device import opened_device
from clsplat.device import Device as OpenedDevice
from clsplat.errors import InputError
from clsplat.evaluation import score
from clsplat.evaluation.views import depth_to_align, evaluate_views, final_metrics
from clsplat.gaussians import Gaussians
from clsplat.rendering.slabs import open_model
from clsplat.report.notebook import table
from clsplat.scene import Scene


class Score(score.Score):
    __doc__ = score.Score.__doc__

    def _repr_html_(self) -> str:
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


def evaluate(model: Gaussians, scene: Scene, *, device: OpenedDevice | None = None,
             test_every: int = 8, test_offset: int = 0, near: float | None = None,
             antialiased: bool = False, background: tuple[float, float, float] = (0.0, 0.0, 0.0),
             lpips: str | PathLike[str] | None = None, align: bool = False) -> Score:
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
    renderer, rows = open_model(opened_device(device), model.moved(scene.offset),
                                scene.near(near or 0), antialiased, background)
    return Score.of(evaluate_views(renderer, rows, model.sh_degree, views,
                                   metrics=final_metrics(lpips),
                                   align=depth_to_align(scene) if align else 0.0))
