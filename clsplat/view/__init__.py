"""A page on this machine that shows our own renderer's frames: of a run, or while it trains."""
