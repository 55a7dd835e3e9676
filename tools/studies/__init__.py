"""The experiments behind the defaults; not shipped. Each writes, or checks, a page of docs/."""
