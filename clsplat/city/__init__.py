"""A large scene's training: coarse run, partition, one run a block, merge, evaluation.

Each stage looks into the city's folder for what is done, does the rest, and may be called again
after any failure. `clsplat city` calls all of them, and each is a command of its own.
"""
