"""The errors that a user can meet. Each message is one line that names the cause and the cure."""

MOST_CHARACTERS = 200  # of the reason of another library


class ClsplatError(Exception):
    """Base of every error that the command line reports in one line, with exit code 2."""


class InputError(ClsplatError):
    """A file, scene or option that cannot be used; the message names it and says what to do."""


TOO_LARGE = "does not fit the device"  # in the message of an OutOfDeviceMemory


class DeviceError(ClsplatError):
    """No working OpenCL device, a kernel that does not build, or too little memory."""


class OutOfDeviceMemory(DeviceError):
    """An array does not fit the device: memory was refused, or one buffer would be too large."""


class TooFewPages(OutOfDeviceMemory):
    """A view sees more than there is memory for, and nothing else can be given back for it."""


class ShapeError(ClsplatError):
    """An array passed to a kernel has the wrong shape or type; the message names the argument."""


class StopTraining(Exception):
    """A callback of `clsplat.train` raises it to end the training after this step."""


class Interrupted(ClsplatError):
    """Training was stopped by the user after its state was saved.

    Attributes
    ----------
    planned : whether an option or a callback requested it rather than a signal.
    """

    def __init__(self, message: str = "", planned: bool = False) -> None:
        super().__init__(message)
        self.planned = planned


def reason(error: BaseException) -> str:
    """The cause that another library gives, as part of one line: the first line of an exception in
    printable characters, or its type if it has no text."""
    if isinstance(error, OSError) and error.strerror:  # the file is named by the message around it
        return clean(error.strerror)
    return clean(next(iter(str(error).splitlines()), "")) or type(error).__name__


def clean(text: str) -> str:
    """The beginning of a line, in printable characters."""
    return (text if text.isprintable() else ascii(text))[:MOST_CHARACTERS]
