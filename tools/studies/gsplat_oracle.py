"""The reference against an independent one: gsplat 1.5.3's pure-torch code, on the CPU, in float64.

Needs torch and gsplat, which clsplat does not. To run it, from the root:

    python -m venv /tmp/oracle
    /tmp/oracle/bin/pip install torch==2.13.0 -e .[test,cpu] && \
        /tmp/oracle/bin/pip install --no-deps gsplat==1.5.3
    /tmp/oracle/bin/python -m tools.studies.gsplat_oracle

gsplat's projection, spherical harmonics, accumulation and torch's derivatives of them are used.
Its lists of pairs come from CUDA, and its sums along rays from nerfacc (CUDA too), so these two are
written here from their documentation. Where gsplat differs from clsplat, the cases stay clear:

- alpha is clamped at 0.999, not 0.99: opacities stay below 0.99;
- a pixel stops where T would become <= 1e-4, not < 1e-4: never equal here;
- splats are cut at 3.33 sigma, not at alpha = 1/255: the latter is never farther out (2 ln 255 is
  3.329^2), and both skip alpha < 1/255;
- the antialiased factor has no floor (clsplat: area share 2.5e-5): no splat here is so thin;
- the determinant is a difference of products, and at least 1e-10: no needles here.
"""

import itertools
import sys
import types

import numpy as np
import torch

from tests import cases
from tests.checks import close
from tests.reference.blend import blend, blend_adjoint
from tests.reference.project import project, project_adjoint

CASES = (
    "plain",
    "ragged",
    "grazing",
    "less_than_a_tile",
    "degree_0",
    "degree_1",
    "degree_2",
    "lower_degree_active",
    "stack",
)


def main():
    sys.modules["nerfacc"] = types.SimpleNamespace(
        render_weight_from_alpha=render_weight_from_alpha, accumulate_along_rays=accumulate_along_rays
    )
    from gsplat.cuda import _torch_impl

    for name, antialiased in itertools.product(CASES, (False, True)):
        compare(_torch_impl, name, antialiased)
        print(f"{name}{', antialiased' if antialiased else ''}: agrees")


def compare(gsplat, name, antialiased):
    """Image, depth and all gradients of a case, within the rounding of float64."""
    case = cases.gaussians(name, seed=5)
    case["rows"]["opacity_logits"] = np.minimum(case["rows"]["opacity_logits"], 4)
    camera, degree, near = case["camera"], case["degree"], case["near"]
    size, arguments = (camera["width"], camera["height"]), (camera, degree, near)
    rng = np.random.default_rng(0)
    grad_image, grad_depth = rng.normal(size=(3, *size[::-1])), rng.normal(size=size[::-1])

    rows = {key: torch.tensor(value, requires_grad=True) for key, value in case["rows"].items()}
    image, alpha, depth = render(gsplat, rows, case, antialiased)
    ((image * torch.tensor(grad_image)).sum() + (depth * torch.tensor(grad_depth)).sum()).backward()

    splats = project(case["rows"], *arguments, antialiased=antialiased)
    order = np.argsort(splats["depths"], kind="stable")
    order = order[splats["visible"][order]]
    drawn, transmittance, drawn_depth = blend(splats, order, *size, case["background"], with_depth=True)
    assert transmittance.min() < (1e-3 if name == "stack" else 1)
    close(drawn, image.detach(), "double", "image")
    close(1 - transmittance, alpha.detach(), "double", "alpha")
    close(drawn_depth, depth.detach(), "double", "depth")

    by_splat = blend_adjoint(splats, order, *size, case["background"], grad_image, grad_depth)
    grads = project_adjoint(case["rows"], *arguments, antialiased=antialiased, grads=by_splat)
    for key, grad in grads.items():
        theirs = np.zeros(grad.shape) if rows[key].grad is None else rows[key].grad
        close(grad, theirs, "double", f"gradient of {key}")


def render(gsplat, rows, case, antialiased):
    """image[3, H, W], alpha[H, W] and depth[H, W] by gsplat."""
    camera = case["camera"]
    width, height = camera["width"], camera["height"]
    view = torch.eye(4, dtype=torch.float64)
    view[:3, :3], view[:3, 3] = (torch.tensor(camera[key]) for key in ("rotation", "translation"))
    intrinsics = torch.tensor(
        [[camera["fx"], 0, camera["cx"]], [0, camera["fy"], camera["cy"]], [0, 0, 1]], dtype=torch.float64
    )
    covariances, _ = gsplat._quat_scale_to_covar_preci(
        rows["quaternions"], rows["log_scales"].exp(), compute_preci=False
    )
    radii, means, depths, conics, factors = gsplat._fully_fused_projection(
        rows["positions"],
        covariances,
        view[None],
        intrinsics[None],
        width,
        height,
        near_plane=float(case["near"]),
        calc_compensations=antialiased,
    )
    opacities = rows["opacity_logits"].sigmoid()[None]
    if antialiased:
        opacities = opacities * factors
    # not by the inverse: the case's rotation is rounded to float32, so its transpose differs
    directions = rows["positions"] + view[:3, :3].T @ view[:3, 3]
    coefficients = torch.cat([rows["sh_constant"][:, None], rows["sh_rest"]], dim=1)
    colours = gsplat._spherical_harmonics(case["degree"], directions, coefficients)
    channels = torch.cat([(colours + 0.5).clamp_min(0)[None], depths[..., None]], dim=-1)
    gaussian, pixel = pairs(means[0], conics[0], opacities[0], radii[0], depths[0], width, height)
    drawn, alpha = gsplat.accumulate(
        means, conics, opacities, channels, gaussian, pixel, torch.zeros_like(gaussian), width, height
    )
    image = drawn[0, ..., :3] + (1 - alpha[0]) * torch.tensor(case["background"])
    return image.permute(2, 0, 1), alpha[0, ..., 0], drawn[0, ..., 3]


@torch.no_grad()
def pairs(means, conics, opacities, radii, depths, width, height):
    """(gaussian, pixel) of everything drawn, by pixel, front to back: gsplat's rules for CUDA."""
    order = torch.argsort(depths, stable=True)
    order = order[(radii[order] > 0).all(-1)]
    line, column = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    centres = torch.stack([column, line], dim=-1).reshape(-1, 1, 2) + 0.5
    dx, dy = (centres - means[order]).unbind(-1)
    a, b, c = conics[order].unbind(-1)
    alpha = opacities[order] * torch.exp(-(a * dx**2 + c * dy**2) / 2 - b * dx * dy)
    alpha = torch.where(alpha < 1 / 255, 0, alpha)
    assert alpha.max() < 0.99
    pixel, place = torch.nonzero((alpha > 0) & (torch.cumprod(1 - alpha, dim=1) > 1e-4), as_tuple=True)
    return order[place], pixel


def render_weight_from_alpha(alphas, ray_indices, n_rays):
    """Weights alpha T and T of samples that are grouped by ray, front to back."""
    position = torch.arange(len(alphas))
    new_ray = torch.ones_like(position, dtype=torch.bool)
    new_ray[1:] = ray_indices[1:] != ray_indices[:-1]
    first = torch.cummax(torch.where(new_ray, position, 0), dim=0).values
    before = torch.cumsum(torch.log1p(-alphas), dim=0) - torch.log1p(-alphas)
    transmittance = torch.exp(before - before[first])
    return alphas * transmittance, transmittance


def accumulate_along_rays(weights, values, ray_indices, n_rays):
    """Sums over each ray of the weights, or of the weighted values."""
    terms = weights[:, None] if values is None else weights[:, None] * values
    return torch.zeros(n_rays, terms.shape[-1], dtype=terms.dtype).index_add(0, ray_indices, terms)


if __name__ == "__main__":
    main()
