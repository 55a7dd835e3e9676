"""What a device can do: the time of a training step, and a self-test."""
