"""Edits of finished models: crop, remove floaters, merge, decimate and transform."""
