"""A scene cut into blocks that are trained independently: their cells, and the views of each block.

`make.make_partition` is the entry point.
"""
