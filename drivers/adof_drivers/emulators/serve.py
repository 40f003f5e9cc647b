"""An engine behind a real connection: a TCP port on this machine, or a pseudo terminal. One client at a time.

    with Served.tcp(engine) as served:
        TcpTransport("127.0.0.1", served.port)

A reply held back does not hold back what is received: a stop acts while an answer is pending.
"""

from __future__ import annotations

import contextlib
import os
import selectors
import socket
import threading
import time
from collections import deque
from ipaddress import ip_address
from types import TracebackType

from adof_drivers.emulators.engine import Disconnected, Engine
from adof_drivers.errors import RequestError


class Served:
    """A thread that carries bytes between an engine and one client; `address` says where. A context."""

    def __init__(self, engine: Engine, *, listener: socket.socket | None, terminal: int | None) -> None:
        self.engine = engine
        self.address = ""
        self.port = 0
        self._listener = listener
        self._terminal = terminal
        self._client: socket.socket | None = None
        self._held: deque[tuple[float, bytes]] = deque()
        self._wake_out, self._wake_in = os.pipe()
        self._selector = selectors.DefaultSelector()
        self._selector.register(self._wake_out, selectors.EVENT_READ)
        for source in (listener, terminal):
            if source is not None:
                self._selector.register(source, selectors.EVENT_READ)
        self._thread = threading.Thread(target=self._run, name="emulated device", daemon=True)

    @classmethod
    def tcp(cls, engine: Engine, host: str = "127.0.0.1", port: int = 0) -> Served:
        """Listen on a loopback address; port 0 takes a free one.

        Raises
        ------
        RequestError
            Not a loopback address, or the port is taken.
        """
        try:
            loopback = host == "localhost" or ip_address(host).is_loopback
        except ValueError:
            loopback = False
        if not loopback:
            raise RequestError(f"{host} can be reached from outside: an emulator listens on 127.0.0.1 only")
        try:
            listener = socket.create_server((host, port), backlog=1)
        except (OSError, OverflowError) as failure:
            raise RequestError(
                f"{host}:{port} cannot be listened on ({failure}): give another port"
            ) from None
        served = cls(engine, listener=listener, terminal=None)
        served.port = listener.getsockname()[1]
        served.address = f"{host}:{served.port}"
        return served

    @classmethod
    def pty(cls, engine: Engine) -> Served:
        """Make a pseudo terminal; `address` is the device a client opens."""
        import tty

        master, slave = os.openpty()
        tty.setraw(slave)
        served = cls(engine, listener=None, terminal=master)
        served.address = os.ttyname(slave)
        served._slave = slave  # kept open: with no client the master would read errors
        return served

    _slave: int | None = None

    def __enter__(self) -> Served:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        os.write(self._wake_in, b"x")
        self._thread.join()
        for held in (self._client, self._listener, self._selector):
            if held is not None:
                held.close()
        for number in (self._wake_in, self._wake_out, self._terminal, self._slave):
            if number is not None:
                os.close(number)

    def _run(self) -> None:
        while True:
            timeout_s = max(0.0, self._held[0][0] - time.monotonic()) if self._held else None
            for key, _ in self._selector.select(timeout_s):
                if key.fileobj == self._wake_out:
                    return
                if key.fileobj is self._listener:
                    self._accept()
                else:
                    self._receive()
            while self._held and self._held[0][0] <= time.monotonic():
                self._send(self._held.popleft()[1])

    def _accept(self) -> None:
        assert self._listener is not None
        newcomer, _ = self._listener.accept()
        if self._client is not None:
            newcomer.close()  # the controller has one interface, and it is taken
            return
        newcomer.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._client = newcomer
        self._selector.register(newcomer, selectors.EVENT_READ)

    def _receive(self) -> None:
        try:
            data = self._client.recv(4096) if self._client is not None else os.read(self._terminal or 0, 4096)
        except OSError:
            data = b""
        if not data:
            self._drop()
            return
        try:
            for reply in self.engine.feed(data):
                due_s = max(time.monotonic() + reply.delay_s, self._held[-1][0] if self._held else 0.0)
                self._held.append((due_s, reply.data))
        except Disconnected:
            self._drop()

    def _send(self, data: bytes) -> None:
        with contextlib.suppress(OSError):  # the client has gone meanwhile
            if self._client is not None:
                self._client.sendall(data)
            elif self._terminal is not None:
                os.write(self._terminal, data)

    def _drop(self) -> None:
        self._held.clear()
        self.engine.disconnected()
        if self._client is not None:
            self._selector.unregister(self._client)
            self._client.close()
            self._client = None
