"""The folders of runs and cities: the only code that knows their file names."""
