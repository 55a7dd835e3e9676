"""Scenes of every format, read and written."""
