"""A scene cut into blocks that are trained independently: their cells, and the views of each block.

`make_partition` is the entry point; its methods share one signature.
"""

from clsplat.partition.make import METHODS, PartitionOptions, make_partition
from clsplat.partition.outline import geojson
from clsplat.partition.partition import Partition

__all__ = ["METHODS", "Partition", "PartitionOptions", "geojson", "make_partition"]
