"""The public Python API: what `import clsplat` offers beside the nouns (Scene, Camera, Gaussians).

The command line and this package stand on the same modules; nothing here knows of click.
"""
