"""From gaussians to an image and back: project, bin and blend, one module for each kernel family.

`pipeline.Renderer` joins them. Images are planar, real[3, H, W].
"""
