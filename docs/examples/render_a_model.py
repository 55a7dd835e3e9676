"""Render a model from the cameras of a scene: python render_a_model.py SCENE MODEL.ply OUT.npy"""

import sys

import numpy as np

import clsplat

scene, model = clsplat.Scene.read(sys.argv[1]), clsplat.Gaussians.load(sys.argv[2])
image = clsplat.render(model, scene.views[0].camera)
np.save(sys.argv[3], image)
print(f"{scene.views[0].name}: {image.shape[1]} x {image.shape[0]} pixels, mean {image.mean():.3f}")
