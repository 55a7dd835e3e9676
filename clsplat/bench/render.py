"""Forward, and forward with adjoint, of the aerial city; with --gsplat also those of gsplat.

The loss is the mean of the squares of the image.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from clsplat.camera import Camera
from clsplat.constants import COUNT_FAILED, FRAME_COUNTS
from clsplat.device import Device, Graph
from clsplat.errors import DeviceError
from clsplat.gaussians import Gaussians
from clsplat.rendering.pipeline import Renderer, Room

from .measure import Bench
from .timing import milliseconds
from .workloads import city


def main(argv: list[str]) -> None:
    """Run this benchmark with its flags."""
    bench = Bench(argv, __doc__, gaussians="200k,1M,4M", gsplat=False)
    for count in bench.options.gaussians:
        gaussians, cameras = city(count)
        peers: dict[str, Clsplat | Gsplat] = {
            "render": Clsplat(bench.device, gaussians, cameras)}
        if bench.options.gsplat:
            peers["gsplat"] = Gsplat(gaussians, cameras)
        for family, peer in peers.items():
            for case in ("forward", "both"):
                times = milliseconds(peer, getattr(peer, case), bench.options.repeats)
                bench.report(family, "forward + adjoint" if case == "both" else case, times,
                             {"gaussians": count, "width": cameras[0].width,
                              "height": cameras[0].height})


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
        needs = [self.renderer.count(self.rows, camera, self.width, self.height)
                 for camera in self.cameras]
        self.room = Room(*(max(need) for need in zip(*needs)))
        self.counts = device.zeros(FRAME_COUNTS, np.uint32)
        # of the gradient's size: its values do not change the work
        self.grad = device.upload(np.full((3, self.height, self.width),
                                          1 / (3 * self.height * self.width)))
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
            frame = self.renderer.render(self.rows, camera, self.width, self.height, 3,
                                         room=self.room, counts=self.counts)
            if back:
                self.renderer.adjoint(self.rows, frame, self.grad)
        self._graphs[back] = graph

    def finish(self) -> None:
        """Wait for the device; DeviceError if a frame had no room, and so was not drawn."""
        if self.counts.download()[COUNT_FAILED]:
            raise DeviceError("a frame of the benchmark had no room")


class Gsplat:
    """gsplat 1.5.3 on the same gaussians; needs CUDA, PyTorch and gsplat."""

    def __init__(self, gaussians: Gaussians, cameras: Sequence[Camera]) -> None:
        import gsplat
        import torch

        self.torch, self.rasterise, self.turn = torch, gsplat.rasterization, 0
        rows = {name: torch.tensor(values, device="cuda")
                for name, values in gaussians.rows.items()}
        self.parameters = [
            rows["positions"], rows["quaternions"], rows["log_scales"].exp(),
            rows["opacity_logits"].sigmoid(),
            torch.cat([rows["sh_constant"][:, None], rows["sh_rest"]], 1)]
        for parameter in self.parameters:
            parameter.requires_grad_()
        self.views = []
        for c in cameras:
            pose, calibration = np.eye(4, dtype=np.float32), np.eye(3, dtype=np.float32)
            pose[:3, :3], pose[:3, 3] = c.rotation, c.translation
            calibration[:2] = [[c.focal[0], 0, c.centre[0]], [0, c.focal[1], c.centre[1]]]
            self.views.append((torch.tensor(pose, device="cuda")[None],
                               torch.tensor(calibration, device="cuda")[None], c.width, c.height))

    def _render(self) -> Any:
        pose, calibration, width, height = self.views[self.turn % len(self.views)]
        self.turn += 1
        return self.rasterise(*self.parameters, pose, calibration, width, height, sh_degree=3,
                              packed=False)[0]

    def forward(self) -> None:
        """Render."""
        with self.torch.no_grad():
            self._render()

    def both(self) -> None:
        """Render, and take the gradients."""
        self._render().square().mean().backward()
        for parameter in self.parameters:
            parameter.grad = None

    def finish(self) -> None:
        """Wait for the device."""
        self.torch.cuda.synchronize()
