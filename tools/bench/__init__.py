"""Benchmarks of kernel families and of whole frames, on a made city: `python -m tools.bench`."""
