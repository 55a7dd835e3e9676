"""Gaussians in files of every format."""
