"""What other libraries say of a damaged file, as part of one line."""

LONGEST = 200  # characters


def reason(error):
    """The first line of an exception, clean; its type where it says nothing."""
    if isinstance(error, OSError) and error.strerror:  # the number and the file say nothing more
        return clean(error.strerror)
    return clean(next(iter(str(error).splitlines()), "")) or type(error).__name__


def clean(text):
    """A line's beginning, in printable characters."""
    return (text if text.isprintable() else ascii(text))[:LONGEST]
