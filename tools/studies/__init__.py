"""The experiments behind the defaults, which are not shipped; results are in docs/notebook."""
