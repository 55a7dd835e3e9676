"""Training: `step` reads as the algorithm, `loop` runs it to the end and survives being stopped."""
