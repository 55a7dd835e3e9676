"""What `clsplat devices --check` expects, by the float64 reference.
`tests/bench/test_selftest.py` writes them into `clsplat/bench/selftest.npz`, and compares.
"""

import numpy as np

from tests.reference.adam import adam
from tests.reference.blend import blend, blend_adjoint, fragile_pixels
from tests.reference.image_loss import image_loss
from tests.reference.project import C0, project, project_adjoint
from tests.reference.statistics import accumulate

COUNT, BORDER = 250, 0.5  # gaussians; pixels around the border that no footprint ends in


def stored(camera, near, background, degree, ssim_weight, rates, later):
    """The arrays that `clsplat.bench.selftest.stored` describes, in its terms."""
    rng = np.random.default_rng(9)
    depth = rng.permutation(np.linspace(2, 6, COUNT))
    positions = np.column_stack([rng.uniform(-0.8, 0.8, (COUNT, 2)) * depth[:, None], depth])
    rows = {
        "positions": positions - camera.translation,
        "sh_constant": rng.uniform(0, 1, (COUNT, 3)) / C0,
        "sh_rest": rng.normal(0, 0.1, (COUNT, 3, 3)),
        "opacity_logits": rng.uniform(-2, 2, COUNT),
        "log_scales": np.log(0.1) + rng.normal(0, 0.5, (COUNT, 3)),
        "quaternions": rng.normal(size=(COUNT, 4)),
    }
    rows = {name: values.astype(np.float32).astype(float) for name, values in rows.items()}
    size = camera.width, camera.height
    view = {
        "width": camera.width,
        "height": camera.height,
        "fx": camera.focal[0],
        "fy": camera.focal[1],
        "cx": camera.centre[0],
        "cy": camera.centre[1],
        "rotation": camera.rotation,
        "translation": camera.translation,
    }
    # those that are close to the border are pushed behind the camera
    wide = {**view, "width": 3 * size[0], "height": 3 * size[1], "cx": view["cx"] + size[0], "cy": view["cy"] + size[1]}
    splats = project(rows, wide, degree, near)
    means = splats["means"] - size
    inside = np.hstack([means + splats["extents"], size - means + splats["extents"]]).min(1)
    rows["positions"][np.abs(inside) < BORDER, 2] = -5

    splats = project(rows, view, degree, near)
    seen = splats["visible"]
    order = np.flatnonzero(seen)[np.argsort(splats["depths"][seen], kind="stable")]
    image = blend(splats, order, *size, background)[0]
    sure = ~fragile_pixels(splats, order, *size)
    off = rng.choice((-1, 1), image.shape) * rng.uniform(5, 50, image.shape)
    photo = np.clip(255 * image + off, 0, 255).astype(np.uint8)
    loss, grad_image, _, _ = image_loss(image, photo / 255, ssim_weight)
    weights = (sure * rng.choice((-1, 1), image.shape)).astype(np.int8)
    by_splat = blend_adjoint(splats, order, *size, background, weights.astype(float))
    grads = project_adjoint(rows, view, degree, near, grads=by_splat)
    screen, _ = accumulate(np.zeros(COUNT), np.zeros(COUNT, int), by_splat["means"], seen, *size)
    later_rows = np.flatnonzero(seen)[1:]
    result = {
        "visible": seen,
        "image": image,
        "photo": photo,
        "loss": np.float64(loss),
        "grad_image": grad_image,
        "weights": weights,
        "screen": screen,
    }
    for name, values in rows.items():
        after, first, second = values, np.zeros(values.shape), np.zeros(values.shape)
        for step, factor in ((1, 1.0), (2, later)):
            after, first, second = adam(after, factor * grads[name], first, second, step, rates[name], later_rows)
        result |= {f"in_{name}": values, f"grad_{name}": grads[name], f"out_{name}": after}
    return {
        name: values.astype(np.float32) if values.dtype == float and values.ndim else values
        for name, values in result.items()
    }
