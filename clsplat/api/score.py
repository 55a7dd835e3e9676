"""`clsplat.evaluate`: how well a model renders the photos of a scene."""

from clsplat.api.device import best_device
from clsplat.device import Device as OpenedDevice
from clsplat.errors import InputError
from clsplat.evaluation.score import Score
from clsplat.evaluation.views import evaluate_views
from clsplat.gaussians import Gaussians
from clsplat.rendering.slabs import open_model
from clsplat.scene import Scene


def evaluate(model: Gaussians, scene: Scene, *, device: OpenedDevice | None = None,
             test_every: int = 8, near: float | None = None, antialiased: bool = False,
             background: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Score:
    """Compare renders of a model with the held-out photos of a scene.

    Parameters
    ----------
    model : the gaussians, with the scene's offset.
    scene : the views, rendered at the size of their cameras; see `Scene.reduced`.
    device : an open device; None: the best one that works.
    test_every : every test_every-th view by name is held out; 0: all views are compared.
    near, antialiased, background : as for `clsplat.render`.

    Returns
    -------
    The Score.

    Raises
    ------
    clsplat.ClsplatError : if no view is held out, or a photo cannot be read.
    """
    views = scene.split(test_every)[1] if test_every else scene.views
    if not views:
        raise InputError(f"{scene.name}: no view is held out; use another test_every")
    if (model.offset != scene.offset).any():
        model = model.moved(scene.offset)
    renderer, rows = open_model(device or best_device(), model, scene.near(near or 0),
                                antialiased, background)
    return Score.of(evaluate_views(renderer, rows, model.sh_degree, views))
