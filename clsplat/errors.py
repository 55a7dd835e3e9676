"""The errors that a user can meet. Each message is one line that names the cause and the cure."""


class ClsplatError(Exception):
    """Base of every error that the command line reports in one line, with exit code 2."""


class InputError(ClsplatError):
    """A file, scene or option that cannot be used; the message names it and says what to do."""


TOO_LARGE = "does not fit the device"  # in the message of an OutOfDeviceMemory


class DeviceError(ClsplatError):
    """No working OpenCL device, a kernel that does not build, or too little memory."""


class OutOfDeviceMemory(DeviceError):
    """An array does not fit the device: memory was refused, or one buffer would be too large."""


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
