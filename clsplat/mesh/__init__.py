"""Triangle meshes: a surface as signed distances of a volume, and what is made of them."""
