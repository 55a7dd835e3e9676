"""Photos with what lies beside them: masks, depth maps, lenses, metadata."""
