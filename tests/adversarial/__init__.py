"""Hostile files and extreme numbers: one case a class; the campaign is marked `nightly`."""
