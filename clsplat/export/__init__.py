"""Export: a run as a page, a map, a film, tiles for a globe, or a model for other programs."""
