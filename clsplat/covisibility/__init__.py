"""Which photos of a scene show the same, and how their brightness differs."""
