"""Adam, with moments for each field of the gaussians, and learning rates."""
