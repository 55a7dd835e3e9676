"""What is asked of the gaussians beside looking like the photo at hand."""
