"""Reports from the records of runs: a page for each run, comparisons, models in a page, maps."""
