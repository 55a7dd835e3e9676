"""Ten losses of a small fixed training by a trainer made of tests/reference alone, in float64.

`tools/golden` runs this file and stores the losses in golden.json; test_golden.py compares.
"""

import json
from pathlib import Path

import numpy as np

from tests.cases import single
from tests.reference.adam import adam
from tests.reference.blend import blend, blend_adjoint
from tests.reference.image_loss import image_loss
from tests.reference.project import SH_BANDS, project, project_adjoint

STORED = Path(__file__).with_name("golden.json")

STEPS, COUNT, WIDTH, HEIGHT, DEGREE = 10, 60, 32, 24, 2
SH_EVERY = 4
EXTENT, NEAR, SSIM_WEIGHT = 2.5, single(0.2), 0.2
BACKGROUND = single(np.array([0.1, 0.3, 0.2]))
RATES = {
    "positions": 1.6e-4,
    "sh_constant": 2.5e-3,
    "sh_rest": 1.25e-4,
    "opacity_logits": 5e-2,
    "log_scales": 5e-3,
    "quaternions": 1e-3,
}  # Kerbl et al. 2023


def scene():
    """(rows to start from, cameras, photos uint8[3, H, W]): a ball of gaussians from three sides,
    the photos rendered from the same ball before it was disturbed."""
    rng = np.random.default_rng(2)
    rows = {
        "positions": rng.normal(0, 0.6, (COUNT, 3)),
        "log_scales": rng.normal(-1.7, 0.4, (COUNT, 3)),
        "quaternions": rng.normal(0, 1, (COUNT, 4)),
        "opacity_logits": rng.uniform(-2, 2, COUNT),
        "sh_constant": rng.normal(0.3, 0.8, (COUNT, 3)),
        "sh_rest": rng.normal(0, 0.2, (COUNT, SH_BANDS[DEGREE] - 1, 3)),
    }
    cameras = [camera(angle) for angle in (-0.6, 0.1, 0.9)]
    photos = []
    for seen_by in cameras:
        image = forward(rows, seen_by, DEGREE)[2]
        photos.append(np.round(255 * np.clip(image, 0, 1)).astype(np.uint8))
    size = {"positions": 0.05, "sh_constant": 0.3, "log_scales": 0.2, "opacity_logits": 0.5}
    disturbed = {name: values + rng.normal(0, size.get(name, 0.1), values.shape) for name, values in rows.items()}
    return single(disturbed), cameras, photos


def camera(angle):
    """A camera four units from the origin that looks at it, turned about the y axis."""
    c, s = np.cos(angle), np.sin(angle)
    return single(
        {
            "width": WIDTH,
            "height": HEIGHT,
            "fx": 30.0,
            "fy": 31.0,
            "cx": 15.2,
            "cy": 12.9,
            "rotation": np.array([[c, 0, -s], [0, 1, 0], [s, 0, c]]),
            "translation": np.array([0.1, -0.05, 4.0]),
        }
    )


def forward(rows, seen_by, degree):
    """(splats, their order, image[3, H, W])"""
    splats = project(rows, seen_by, degree, NEAR)
    visible = np.flatnonzero(splats["visible"])
    order = visible[np.argsort(splats["depths"][visible], kind="stable")]
    return splats, order, blend(splats, order, WIDTH, HEIGHT, BACKGROUND)[0]


def losses():
    """The loss before each of STEPS steps; views in turn."""
    rows, cameras, photos = scene()
    moments = {name: (np.zeros(values.shape),) * 2 for name, values in rows.items()}
    found = []
    for step in range(1, STEPS + 1):
        seen_by, photo = cameras[step % 3], photos[step % 3] / 255
        degree = min(DEGREE, (step - 1) // SH_EVERY)
        splats, order, image = forward(rows, seen_by, degree)
        loss, grad_image, _, _ = image_loss(image, photo, SSIM_WEIGHT)
        found.append(loss)
        by_splat = blend_adjoint(splats, order, WIDTH, HEIGHT, BACKGROUND, grad_image)
        grads = project_adjoint(rows, seen_by, degree, NEAR, grads=by_splat)
        for name, rate in RATES.items():
            if name == "positions":
                rate *= EXTENT * 0.01 ** ((step - 1) / STEPS)
            rows[name], *moments[name] = adam(rows[name], grads[name], *moments[name], step, rate)
    return found


if __name__ == "__main__":
    STORED.write_text(json.dumps({"losses": losses()}, indent=2) + "\n")
    print(STORED)
