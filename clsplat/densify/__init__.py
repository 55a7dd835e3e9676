"""Growing and pruning: what views say of each gaussian, and what becomes of it."""
