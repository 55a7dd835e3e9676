"""The folders of runs and cities: the only code with their file names."""
