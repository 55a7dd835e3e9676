"""Growing and pruning: statistics of the gaussians over views, and decisions made from them."""
