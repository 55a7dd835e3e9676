"""Readers of the projects of other photogrammetry programs, one program a file.

Each translates its cameras to those of COLMAP; `scene.py` finds photos and builds the scene.
"""
