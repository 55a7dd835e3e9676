"""Forward, and forward with adjoint, of the aerial city.

The loss is the mean of the squares of the image. `tools/studies/gsplat_peer.py` measures gsplat on
the same gaussians.
"""

from collections.abc import Sequence

import numpy as np

from clsplat.camera import Camera
from clsplat.constants import COUNT_FAILED, FRAME_COUNTS
from clsplat.device import Device, Graph
from clsplat.errors import DeviceError
from clsplat.gaussians import Gaussians
from clsplat.rendering.pipeline import Renderer, Room
from tools.bench.report import Bench
from tools.bench.workloads import city


def time_frames(bench: Bench) -> None:
    """Time frames of all numbers of gaussians."""
    for count in bench.gaussians:
        gaussians, cameras = city(count)
        peer = Clsplat(bench.device, gaussians, cameras)
        for variant, function in (("forward", peer.forward), ("forward + adjoint", peer.both)):
            bench.report(
                "render", variant, function, {"gaussians": count, "width": peer.width, "height": peer.height}, peer
            )


class Clsplat:
    """The renderer of clsplat; each call renders the next camera.

    Frames are recorded once and replayed, as in training (clsplat/training/step.py).
    """

    def __init__(self, device: Device, gaussians: Gaussians, cameras: Sequence[Camera]) -> None:
        self.device, self.turn = device, 0
        self.renderer = Renderer(device, gaussians.sh_degree, near=0.01)
        self.rows = {name: device.upload(values) for name, values in gaussians.rows.items()}
        self.width, self.height = cameras[0].width, cameras[0].height
        self.cameras = [self.renderer.pack(camera) for camera in cameras]
        measured = [self.renderer.measure(self.rows, camera, self.width, self.height) for camera in self.cameras]
        self.room = Room(max(visible for visible, _ in measured), max(int(tiles.sum()) for _, tiles in measured))
        self.counts = device.zeros(FRAME_COUNTS, np.uint32)
        # of the gradient's size: its values do not change the work
        self.grad = device.upload(np.full((3, self.height, self.width), 1 / (3 * self.height * self.width)))
        self._graphs: dict[bool, Graph] = {}

    def forward(self) -> None:
        """Render."""
        self._next(False)

    def both(self) -> None:
        """Render, and take the gradients."""
        self._next(True)

    def _next(self, back: bool) -> None:
        camera = self.cameras[self.turn % len(self.cameras)]
        self.turn += 1
        if graph := self._graphs.get(back):
            graph.replay(camera=camera)
            return
        with self.device.record(camera=camera) as graph:
            frame = self.renderer.render(
                self.rows, camera, self.width, self.height, 3, room=self.room, counts=self.counts
            )
            if back:
                self.renderer.adjoint(self.rows, frame, self.grad)
        self._graphs[back] = graph

    def finish(self) -> None:
        """Wait for the device; DeviceError if a frame had no room, and so was not drawn."""
        if self.counts.download()[COUNT_FAILED]:
            raise DeviceError("a frame of the benchmark had no room")
