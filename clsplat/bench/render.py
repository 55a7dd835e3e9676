"""Forward, and forward with adjoint, of the aerial city; with --gsplat also those of gsplat.

The loss is the mean of the squares of the image.
"""

from collections.abc import Sequence
from typing import Any

import numpy as np

from clsplat.camera import Camera
from clsplat.device import Device
from clsplat.gaussians import Gaussians
from clsplat.rendering.pipeline import Renderer

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
    """The renderer of clsplat; each call renders the next camera."""

    def __init__(self, device: Device, gaussians: Gaussians, cameras: Sequence[Camera]) -> None:
        self.device, self.turn = device, 0
        self.renderer = Renderer(device, gaussians.sh_degree, near=0.01)
        self.rows = {name: device.upload(values) for name, values in gaussians.rows.items()}
        self.cameras = [(self.renderer.pack(c), c.width, c.height) for c in cameras]
        # of the gradient's size: its values do not change the work
        width, height = cameras[0].width, cameras[0].height
        self.grad = device.upload(np.full((3, height, width), 1 / (3 * height * width)))

    def forward(self) -> None:
        """Render."""
        camera, width, height = self.cameras[self.turn % len(self.cameras)]
        self.turn += 1
        self.frame = self.renderer.render(self.rows, camera, width, height, sh_degree=3)

    def both(self) -> None:
        """Render, and take the gradients."""
        self.forward()
        self.renderer.adjoint(self.rows, self.frame, self.grad)

    def finish(self) -> None:
        """Wait for the device."""
        self.device.finish()


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
