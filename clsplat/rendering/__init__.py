"""From gaussians to an image and back: project, bin, blend, one wrapper a kernel family.

`pipeline.Renderer` strings them together. Planar images real[3, H, W]; splats in depth order.
"""
