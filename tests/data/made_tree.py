"""Trees of models that no city has."""

from clsplat.cities.tree import CELL, TreeBuilder
from clsplat.io.models.tree import writing_tree


def write_tree(path, blocks, sh_degree, offset, cell=CELL):
    """Write a tree of blocks, which are Gaussians of one frame with this offset."""
    with writing_tree(path, sh_degree, offset) as writer:
        builder = TreeBuilder(writer, cell)
        for block in blocks:
            builder.add(block)
        builder.finish()
