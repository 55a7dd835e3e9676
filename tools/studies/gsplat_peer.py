"""Forward, and forward with adjoint, of the aerial city: clsplat and gsplat 1.5.3 in turns.

    python -m tools.studies.gsplat_peer [--device auto] [--gaussians 200k,1M,4M] [--json]

Needs CUDA, PyTorch and gsplat. The loss is the mean of the squares of the image. Both do the same
work one after the other in each round, so that other work on the machine disturbs both alike.
"""

import argparse
import json

import gsplat
import numpy as np
import torch

from clsplat.device import choose_device
from tools.bench.render import Clsplat
from tools.bench.report import counts
from tools.bench.timing import in_turn, spread
from tools.bench.workloads import city


class Gsplat:
    """The renderer of gsplat; each call renders the next camera."""

    def __init__(self, gaussians, cameras):
        self.turn = 0
        rows = {name: torch.tensor(values, device="cuda") for name, values in gaussians.rows.items()}
        self.parameters = [
            rows["positions"],
            rows["quaternions"],
            rows["log_scales"].exp(),
            rows["opacity_logits"].sigmoid(),
            torch.cat([rows["sh_constant"][:, None], rows["sh_rest"]], 1),
        ]
        for parameter in self.parameters:
            parameter.requires_grad_()
        self.views = []
        for c in cameras:
            pose, calibration = np.eye(4, dtype=np.float32), np.eye(3, dtype=np.float32)
            pose[:3, :3], pose[:3, 3] = c.rotation, c.translation
            calibration[:2] = [[c.focal[0], 0, c.centre[0]], [0, c.focal[1], c.centre[1]]]
            self.views.append(
                (
                    torch.tensor(pose, device="cuda")[None],
                    torch.tensor(calibration, device="cuda")[None],
                    c.width,
                    c.height,
                )
            )

    def _render(self):
        pose, calibration, width, height = self.views[self.turn % len(self.views)]
        self.turn += 1
        return gsplat.rasterization(*self.parameters, pose, calibration, width, height, sh_degree=3, packed=False)[0]

    def forward(self):
        """Render."""
        with torch.no_grad():
            self._render()

    def both(self):
        """Render, and take the gradients."""
        self._render().square().mean().backward()
        for parameter in self.parameters:
            parameter.grad = None

    def finish(self):
        """Wait for the device."""
        torch.cuda.synchronize()


def main():
    """Print the times of both renderers."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--device", default="auto")
    parser.add_argument("--gaussians", type=counts, default="200k,1M,4M")
    parser.add_argument("--repeats", type=int, default=20)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    device = choose_device(options.device)
    for count in options.gaussians:
        gaussians, cameras = city(count)
        peers = {"clsplat": Clsplat(device, gaussians, cameras), "gsplat": Gsplat(gaussians, cameras)}
        for case in ("forward", "both"):
            times = in_turn([(peer, getattr(peer, case)) for peer in peers.values()], options.repeats)
            for name, each in zip(peers, times):
                record = {
                    "peer": name,
                    "case": case,
                    "device": device.name,
                    "gaussians": count,
                    "width": cameras[0].width,
                    "height": cameras[0].height,
                    **spread(each),
                }
                print(
                    json.dumps(record)
                    if options.json
                    else f"{name:8} {case:8} {count:>9,} {record['median_ms']:9.3f} ms",
                    flush=True,
                )


if __name__ == "__main__":
    main()
