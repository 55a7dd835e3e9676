"""What the records of runs say: a page for each run, and comparisons of several.

The only package that imports matplotlib.
"""
