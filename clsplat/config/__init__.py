"""How options are declared (defaults, limits, help), read and compared."""
