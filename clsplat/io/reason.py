"""The cause that another library gives for a damaged file, as part of one line."""

MOST_CHARACTERS = 200


def reason(error: BaseException) -> str:
    """The first line of an exception in printable characters, or its type if it has no text."""
    if isinstance(error, OSError) and error.strerror:  # the file is named by the message around it
        return clean(error.strerror)
    return clean(next(iter(str(error).splitlines()), "")) or type(error).__name__


def clean(text: str) -> str:
    """The beginning of a line, in printable characters."""
    return (text if text.isprintable() else ascii(text))[:MOST_CHARACTERS]
