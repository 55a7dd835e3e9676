"""Training of large scenes: coarse run, partition, a run for each block, merge, evaluation.

Each stage checks in the city's folder what is done, does the rest, and may be called again after
any failure. `clsplat city` calls all of them, and each is a command of its own.
"""
