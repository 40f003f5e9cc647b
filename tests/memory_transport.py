"""A wire of no length between a client and an emulated controller, that may answer falsely."""

from __future__ import annotations

from adof_drivers.emulators.engine import Disconnected, Engine
from adof_drivers.errors import LinkError


class MemoryTransport:
    """An engine with no wire between; `instead` answers the next line in its place."""

    name = "memory"

    def __init__(self, engine: Engine) -> None:
        self.engine = engine
        self._replies = b""
        self.instead: bytes | None = None
        self.closed = False

    def write(self, data: bytes) -> None:
        if self.closed:
            raise LinkError("memory is closed")
        try:
            replies = b"".join(reply.data for reply in self.engine.feed(data))
        except Disconnected:
            self.closed = True
            raise LinkError("memory is cut") from None
        self._replies += replies if self.instead is None else self.instead
        self.instead = None

    def read_some(self, timeout_s: float) -> bytes:
        assert timeout_s >= 0
        piece, self._replies = self._replies[:31], self._replies[31:]
        return piece

    def close(self) -> None:
        self.closed = True
