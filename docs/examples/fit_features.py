"""Learn features of 8 channels from images of features: python fit_features.py

Here the images are labels of 8 classes, as a segmentation of the photos would be, and the gaussians
learn which class they belong to. Features of a network come in the same way.
"""

import numpy as np

import clsplat

COUNT, CLASSES, STEPS, RATE = 400, 8, 60, 0.1

rng = np.random.default_rng(0)
points = rng.normal(size=(COUNT, 3))
points /= np.linalg.norm(points, axis=1, keepdims=True)  # a ball, each octant of it a class
classes = (points > 0) @ (1, 2, 4)
model = clsplat.Gaussians.from_points(points, np.full((COUNT, 3), 128, np.uint8), 0)
model.rows["opacity_logits"][:] = 4
renderer = clsplat.Renderer(model)

cameras = [
    clsplat.Camera.looking_at((0, 0, 0), 3 * np.array(place), up=(0.1, 0.2, 1), width=64, height=64)
    for place in ((1, 1, 1), (-1, -1, -1), (1, -1, 1), (-1, 1, -1), (0, 0, 2), (0, 0, -2))
]
labels = [renderer.forward(camera, features=np.eye(CLASSES)[classes]).image for camera in cameras]

features = np.zeros((COUNT, CLASSES), np.float32)
first, second = np.zeros_like(features), np.zeros_like(features)
for step in range(1, STEPS + 1):
    number = step % len(cameras)
    frame = renderer.forward(cameras[number], features=features)
    difference = frame.image - labels[number]
    gradient = renderer.backward(frame, 2 * difference / difference.size)["features"]
    first += 0.1 * (gradient - first)  # Adam (Kingma and Ba 2015)
    second += 0.01 * (gradient**2 - second)
    mean, spread = first / (1 - 0.9**step), second / (1 - 0.99**step)
    features -= RATE * mean / (np.sqrt(spread) + 1e-12)
    if step % 20 == 0:
        right = np.mean(features.argmax(axis=1) == classes)
        print(f"step {step}: {right:.3f} of the gaussians have their class")
