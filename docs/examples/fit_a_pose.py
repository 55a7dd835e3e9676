"""Find the pose of a camera from its image, by gradient descent: python fit_a_pose.py"""

import numpy as np

import clsplat

STEPS, DISTANCE = 200, 3.0  # at that distance a turn and a shift move what is seen alike
RATES = 0.02 * np.repeat([1, DISTANCE], 3)  # of turns, in radians, and shifts

rng = np.random.default_rng(0)
points = rng.uniform(-1, 1, (100, 3))
model = clsplat.Gaussians.from_points(points, rng.integers(0, 256, (100, 3), np.uint8), 0)
model.rows["opacity_logits"][:] = 0.0
renderer = clsplat.Renderer(model)
wanted = clsplat.Camera.looking_at((0, 0, 0), (0.3, -DISTANCE, 0.5), width=96, height=72)
target = renderer.forward(wanted).image

camera = wanted.moved(turn=(0.04, -0.05, 0.08), shift=(0.1, -0.1, 0.15))
first, second = np.zeros(6), np.zeros(6)
for step in range(STEPS + 1):
    frame = renderer.forward(camera)
    difference = frame.image - target
    if step % 50 == 0:
        away = np.linalg.norm(camera.position - wanted.position)
        print(f"step {step}: {away:.4f} from its place, error {np.mean(difference**2):.2e}")
    gradients = renderer.backward(frame, 2 * difference / difference.size, pose=True)
    gradient = np.concatenate([gradients["turn"], gradients["shift"]])
    first += 0.1 * (gradient - first)  # Adam (Kingma and Ba 2015)
    second += 0.01 * (gradient**2 - second)
    mean, spread = first / (1 - 0.9 ** (step + 1)), second / (1 - 0.99 ** (step + 1))
    move = -RATES * 0.985**step * mean / (np.sqrt(spread) + 1e-12)
    camera = camera.moved(turn=move[:3], shift=move[3:])
