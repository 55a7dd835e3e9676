"""clsplat: large-scale 3D Gaussian-splat training on any OpenCL device."""

__version__ = "0.1.0"
