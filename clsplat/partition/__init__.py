"""A scene cut into blocks that are trained alone: where the cuts are, and who is given which view.

`make_partition` is the way in; its methods share one signature.
"""

from clsplat.partition.make import METHODS, PartitionOptions, make_partition
from clsplat.partition.outline import geojson
from clsplat.partition.partition import Partition

__all__ = ["METHODS", "Partition", "PartitionOptions", "geojson", "make_partition"]
