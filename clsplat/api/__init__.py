"""The public Python API: what `import clsplat` offers besides Scene, Camera and Gaussians.

The command line uses the same modules as this package; nothing here imports click.
"""
