"""Fit gaussians to one image by gradient descent, with numpy alone: python fit_an_image.py"""

import numpy as np

import clsplat

STEPS, COUNT = 200, 400
RATES = {"positions": 0.01, "sh_constant": 0.05, "opacity_logits": 0.05, "log_scales": 0.02}

rng = np.random.default_rng(0)
camera = clsplat.Camera.looking_at((0, 0, 0), (0, -3, 0), width=96, height=64)
y, x = np.mgrid[:64, :96] / 64
target = np.stack([0.5 + 0.5 * np.sin(9 * x), 0.5 + 0.5 * np.cos(7 * y), (x > y) * 0.8], axis=2)

points = rng.uniform((-1.7, -0.2, -1.1), (1.7, 0.2, 1.1), (COUNT, 3))
model = clsplat.Gaussians.from_points(points, rng.integers(0, 256, (COUNT, 3), np.uint8), 0)
renderer = clsplat.Renderer(model)
fields = {name: model.rows[name].copy() for name in RATES}
first = {name: np.zeros_like(values) for name, values in fields.items()}
second = {name: np.zeros_like(values) for name, values in fields.items()}

for step in range(1, STEPS + 1):
    frame = renderer.forward(camera)
    difference = frame.image - target
    gradients = renderer.backward(frame, 2 * difference / difference.size)
    for name, rate in RATES.items():  # Adam (Kingma and Ba 2015)
        first[name] += 0.1 * (gradients[name] - first[name])
        second[name] += 0.01 * (gradients[name] ** 2 - second[name])
        mean = first[name] / (1 - 0.9**step)
        spread = np.sqrt(second[name] / (1 - 0.99**step))
        fields[name] -= rate * mean / (spread + 1e-12)
    renderer.update(**fields)
    if step % 50 == 0 or step == 1:
        print(f"step {step}: {-10 * np.log10(np.mean(difference**2)):.1f} dB")
