"""What a driver raises; each message says what came, what was wanted and what to do."""


class DriverError(Exception):
    """A device or its data cannot do what was asked. Catch this to catch all of them."""


class EndOfSequenceError(DriverError):
    """A replayed sequence has no further frame."""
