"""What uses models and runs: maps, films, tiles, edits, and pages that are served."""
