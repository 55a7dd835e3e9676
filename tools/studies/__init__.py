"""The experiments behind the defaults; not shipped. Each writes a page of docs/notebook."""
