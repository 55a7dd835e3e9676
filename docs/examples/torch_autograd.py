"""Rendering as a function of PyTorch: its gradients reach the gaussians' tensors."""

import numpy as np
import torch

import clsplat

FIELDS = ("positions", "sh_constant", "sh_rest", "opacity_logits", "log_scales", "quaternions")


class Render(torch.autograd.Function):
    """Render.apply(renderer, camera, *tensors in the order of FIELDS) -> image [H, W, 3]."""

    @staticmethod
    def forward(ctx, renderer, camera, *fields):
        renderer.update(**{name: values.detach().cpu() for name, values in zip(FIELDS, fields)})
        ctx.renderer, ctx.frame = renderer, renderer.forward(camera)
        return torch.from_numpy(ctx.frame.image).to(fields[0].device)

    @staticmethod
    def backward(ctx, grad_image):
        found = ctx.renderer.backward(ctx.frame, grad_image.contiguous().cpu())
        return None, None, *(torch.from_numpy(found[name]).to(grad_image.device) for name in FIELDS)


if __name__ == "__main__":
    camera = clsplat.Camera.looking_at((0, 0, 0), (0, -3, 0), width=64, height=48)
    points = np.random.default_rng(0).uniform(-1, 1, (100, 3))
    model = clsplat.Gaussians.from_points(points, np.full((100, 3), 200, np.uint8), sh_degree=1)
    renderer = clsplat.Renderer(model)
    tensors = [torch.tensor(model.rows[name], requires_grad=True) for name in FIELDS]
    optimiser = torch.optim.Adam(tensors, lr=0.02)
    for _ in range(50):
        optimiser.zero_grad()
        loss = (Render.apply(renderer, camera, *tensors) - 0.5).square().mean()
        loss.backward()
        optimiser.step()
    print(f"loss {loss.item():.5f}")
