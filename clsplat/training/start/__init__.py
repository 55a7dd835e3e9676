"""What is decided and found before the first step of a training."""
