"""Draws the gaussians of a training as they are after the last step."""

from clsplat.camera import Camera
from clsplat.device import Array
from clsplat.rendering.pipeline import Frame, Renderer
from clsplat.training.model import Model


class CurrentRenderer:
    """Draws the model of a training, which takes the place of the rows, as it is after the last
    step."""

    def __init__(self, renderer: Renderer) -> None:
        self.renderer = renderer

    def pack(self, camera: Camera, /) -> Array:
        """See `Renderer.pack`."""
        return self.renderer.pack(camera)

    def render(
        self,
        model: Model,
        camera: Array,
        width: int,
        height: int,
        sh_degree: int,
        /,
        with_depth: bool = False,
        *,
        depth_percent: int = 0,
    ) -> Frame:
        """See `Renderer.render`."""
        return model.within(
            lambda: self.renderer.render(
                model.seen(camera), camera, width, height, sh_degree, with_depth, depth_percent=depth_percent
            )
        )
