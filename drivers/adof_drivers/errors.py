"""What a driver raises; each message says what came, what was wanted and what to do."""


class DriverError(Exception):
    """A device or its data cannot do what was asked. Catch this to catch all of them."""


class EndOfSequenceError(DriverError):
    """A replayed sequence has no further frame."""


class RequestError(DriverError):
    """The caller asked for something that is not there or is no number; nothing was sent."""


class LimitError(DriverError):
    """A move beyond a limit; nothing moved."""


class LinkError(DriverError):
    """The connection is gone, refused, or no longer in step."""


class ReplyTimeoutError(LinkError):
    """No whole reply within the time-out."""


class ReplyError(LinkError):
    """A reply that the protocol does not allow."""


class DialectError(DriverError):
    """The device speaks, but is not the kind that was wanted."""


class ControllerError(DriverError):
    """The controller refused. `code` is its own number."""

    def __init__(self, message: str, code: int) -> None:
        super().__init__(message)
        self.code = code


class StoppedError(DriverError):
    """A stop came between the command and its motion."""


class NotArmedError(DriverError):
    """Motion was asked for while the enable latch is open."""


class FollowingError(DriverError):
    """An axis is not where its command should have brought it."""


class FrameTimeoutError(DriverError):
    """No usable frame came in time; the camera may still be there."""


class DeviceLostError(DriverError):
    """A device that was there no longer answers."""


class FrozenFramesError(DriverError):
    """A camera goes on counting but sends the same picture."""
