"""Every error this library raises on purpose.

Each message is one sentence that says what came, what was wanted and what to do. The command line
prints that sentence and exits 2.
"""


class AdofError(Exception):
    """Anything refused or failed for a reason we can name. Catch this to catch all of them."""


class InputError(AdofError, ValueError):
    """A value, shape, type or file the caller gave lies outside what the function accepts."""


class DeviceError(AdofError, RuntimeError):
    """No OpenCL device fits the request, or the device failed or lacks something needed."""


class BuildError(DeviceError):
    """A kernel did not compile; the message names file and line."""


class CalibrationError(AdofError):
    """Calibration data cannot determine what is asked of it, or a calibration file is not ours."""


class TrackingError(AdofError):
    """A feature cannot be followed: no texture, lost, or outside the frame."""


class StreamError(AdofError):
    """A frame under way in a stream failed, or the stream is closed; the message says which frame."""


class LimitError(AdofError):
    """A move or a pattern lies beyond a limit; nothing was sent."""


class BudgetError(AdofError):
    """No plan meets the budget; the message and `nearest` say what comes closest."""

    def __init__(self, sentence: str, nearest: object = None) -> None:
        super().__init__(sentence)
        self.nearest = nearest
