"""What the training views see of each gaussian."""

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from clsplat.device import Device
from clsplat.errors import InputError
from clsplat.gaussians import LEARNED, Gaussians
from clsplat.rendering.contribution import contribution
from clsplat.rendering.pipeline import Renderer
from clsplat.rendering.slabs import gaussian_limit
from clsplat.scene import View

SEEN = 0.1  # opaque pixels that a gaussian must contribute to a view that sees it


def seen_by(device: Device, gaussians: Gaussians, views: Sequence[View], near: float,
            antialiased: bool = False, progress: Callable[[int, int], object] | None = None
            ) -> NDArray[np.intp]:
    """How many views see each gaussian, int[N].

    What counts is its weight in the blended image, so gaussians behind others are not seen.

    Parameters
    ----------
    device : an open device, whose memory holds the model.
    gaussians : in the frame of the views' cameras.
    views : of which only the cameras are used.
    near, antialiased : as for `clsplat.render`.
    progress : called with the number of views that are done, and of all.

    Raises
    ------
    InputError : the model is larger than the device.
    """
    if gaussians.count > gaussian_limit(device, gaussians.sh_degree):
        raise InputError(f"{gaussians.count:,} gaussians are more than {device.name} can render at "
                         "a time to see which views support them; crop the model first, or use "
                         "another --device")
    renderer = Renderer(device, gaussians.sh_degree, near, antialiased)
    rows = {field.name: device.upload(gaussians.rows[field.name]) for field in LEARNED}
    count = np.zeros(gaussians.count, np.intp)
    for number, view in enumerate(views, 1):
        width, height = view.camera.width, view.camera.height
        frame = renderer.render(rows, renderer.pack(view.camera), width, height,
                                gaussians.sh_degree)
        ones = device.upload(np.ones((height, width), device.real))
        visible = frame.visible.download()
        weight = contribution(device, frame, ones).download()[:len(visible), 1]
        count[visible] += weight >= SEEN
        if progress:
            progress(number, len(views))
    return count
