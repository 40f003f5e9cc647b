"""What a driver raises; each message says what came, what was wanted and what to do."""


class DriverError(Exception):
    """A device or its data cannot do what was asked. Catch this to catch all of them."""


class EndOfSequenceError(DriverError):
    """A replayed sequence has no further frame."""


class FrameTimeoutError(DriverError):
    """No usable frame came in time; the camera may still be there."""


class DeviceLostError(DriverError):
    """A device that was there no longer answers."""


class FrozenFramesError(DriverError):
    """A camera goes on counting but sends the same picture."""
