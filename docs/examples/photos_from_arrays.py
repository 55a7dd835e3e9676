"""Train on photos that are arrays, here of a made scene: python photos_from_arrays.py RUN"""

import sys

import numpy as np

import clsplat

rng = np.random.default_rng(0)
points = rng.uniform(-1, 1, (2000, 3))
points /= np.linalg.norm(points, axis=1, keepdims=True)  # a ball
colours = (127 + 127 * np.sin(4 * points)).astype(np.uint8)
ball = clsplat.Gaussians.from_points(points, colours, 0)
ball.rows["opacity_logits"][:] = 4

cameras = [
    clsplat.Camera.looking_at((0, 0, 0), (3 * np.cos(a), 3 * np.sin(a), 1.5 * np.sin(3 * a)), width=96, height=72)
    for a in np.linspace(0, 2 * np.pi, 24, endpoint=False)
]
photos = clsplat.render(ball, cameras=cameras)
views = tuple(
    clsplat.View(f"{number:02d}", camera, np.clip(photo, 0, 1))
    for number, (camera, photo) in enumerate(zip(cameras, photos))
)
scene = clsplat.Scene("ball", views, points[::4], colours[::4])

run = clsplat.train(scene, clsplat.TrainOptions(iterations=400), output=sys.argv[1], overwrite=True)
score = clsplat.evaluate(run.model, scene, near=scene.near_plane)
print(f"{run.model.count} gaussians, PSNR {score.psnr:.1f} dB on {score.views} held-out photos")
