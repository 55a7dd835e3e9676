"""Export: finished models made smaller for viewers and other programs."""
