"""Covisibility: which photos of a scene show the same points, and how their brightness differs."""
