"""Where gaussians may be: the sphere around each one's anchor."""
