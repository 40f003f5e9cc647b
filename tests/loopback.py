"""A watch over what leaves the machine: GigE Vision control packets on any interface but the loopback's."""

from __future__ import annotations

import ctypes
import socket
import struct
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager

_EVERY_PROTOCOL = 0x0003  # ETH_P_ALL
_ATTACH_FILTER = 26  # SO_ATTACH_FILTER
_PORT = 3956
# UDP over IPv4 from or to that port, as tcpdump -dd would write it.
_FILTER = (
    (0x30, 0, 0, 9),
    (0x15, 0, 6, 17),
    (0xB1, 0, 0, 0),
    (0x48, 0, 0, 2),
    (0x15, 2, 0, _PORT),
    (0x48, 0, 0, 0),
    (0x15, 0, 1, _PORT),
    (0x06, 0, 0, 0xFFFF),
    (0x06, 0, 0, 0),
)


def _listening(interface: str) -> socket.socket:
    code = ctypes.create_string_buffer(b"".join(struct.pack("HBBI", *one) for one in _FILTER))
    # Datagrams, so that offsets count from the IP header whatever the link.
    listening = socket.socket(socket.AF_PACKET, socket.SOCK_DGRAM, 0)
    program = struct.pack("HL", len(_FILTER), ctypes.addressof(code))
    listening.setsockopt(socket.SOL_SOCKET, _ATTACH_FILTER, program)
    listening.bind((interface, _EVERY_PROTOCOL))
    listening.setblocking(False)
    return listening


@contextmanager
def control_packets_elsewhere() -> Iterator[list[str] | None]:
    """Yield a list that at the end holds one line for each packet; None if this user may not watch."""
    seen: list[str] = []
    with ExitStack() as stack:
        try:
            watched = [
                (name, stack.enter_context(_listening(name)))
                for _, name in socket.if_nameindex()
                if name != "lo"
            ]
        except PermissionError:
            yield None
            return
        yield seen
        for name, listening in watched:
            while True:
                try:
                    packet = listening.recv(64)
                except OSError:  # no more, or the interface went down
                    break
                source, target = (socket.inet_ntoa(packet[at : at + 4]) for at in (12, 16))
                seen.append(f"{source} to {target} on {name}")
