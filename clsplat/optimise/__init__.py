"""Adam with moments aligned to the gaussians' fields, and learning-rate curves."""
