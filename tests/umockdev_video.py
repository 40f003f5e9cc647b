"""A UVC camera on /dev/video0 under umockdev, for a child process that opens it through the system's V4L2.

Run as `umockdev-wrapper /usr/bin/python3 umockdev_video.py PYTHON CODE`. Frames of 48 x 32 grey pixels come
at 100 Hz, each filled with its number. Lines that the child prints and that begin with a bang are for the
camera: `!stall` (whoever asks for a frame waits for ever), `!unplug`.
"""

import errno
import os
import shutil
import struct
import subprocess
import sys
import threading
import time

import gi

gi.require_version("UMockdev", "1.0")
from gi.repository import GLib, UMockdev  # noqa: E402

COLUMNS, ROWS = 48, 32
PAGE = 4096
GREY = int.from_bytes(b"GREY", "little")
CAPTURE, MEMORY_MAP = 1, 1
CAPABILITIES = 0x04000001  # capture, streaming
BUFFERS = 4
DEVICE = """P: /devices/platform/camera/video4linux/video0
N: video0=00
E: DEVNAME=/dev/video0
E: SUBSYSTEM=video4linux
A: name=Emulated UVC camera
"""


class Camera:
    """What the kernel's V4L2 answers, as far as OpenCV asks."""

    def __init__(self, path: str) -> None:
        # A regular file, so that the program can map its buffers.
        self._memory = os.open(path, os.O_RDWR)
        os.ftruncate(self._memory, BUFFERS * PAGE)
        self._queued: list[int] = []
        self._number = 0
        self._due_s = time.monotonic()
        self.stalled = threading.Event()
        self.gone = threading.Event()

    def answer(self, _handler: object, client: UMockdev.IoctlClient) -> bool:
        request = client.get_request() & 0xFFFFFFFF
        if request >> 8 & 0xFF != ord("V"):
            return False
        try:
            if self.gone.is_set():
                raise OSError(errno.ENODEV, "unplugged")
            content = client.get_arg().resolve(0, request >> 16 & 0x3FFF)
            reply = self._obey(request & 0xFF, bytes(content.retrieve()))
            if reply:
                content.update(0, reply)
        except OSError as failure:
            client.complete(-1, failure.errno)
        else:
            client.complete(0, 0)
        return True

    def _obey(self, command: int, asked: bytes) -> bytes:
        if command == 0:  # QUERYCAP
            return struct.pack(
                "16s32s32sIII12x", b"uvcvideo", b"Emulated", b"usb-1", 1, CAPABILITIES, CAPABILITIES
            )
        if command in (4, 5, 64):  # G_FMT, S_FMT, TRY_FMT
            picture = struct.pack("IIIIII", COLUMNS, ROWS, GREY, 1, COLUMNS, COLUMNS * ROWS)
            return struct.pack("I4x", CAPTURE) + picture
        if command == 8:  # REQBUFS
            count = min(int.from_bytes(asked[:4], "little"), BUFFERS)
            self._queued = []
            return struct.pack("III", count, CAPTURE, MEMORY_MAP)
        index = int.from_bytes(asked[:4], "little")
        if command == 9:  # QUERYBUF
            return self._buffer(index, 0)
        if command == 15:  # QBUF
            self._queued.append(index)
            return self._buffer(index, 0)
        if command == 17:  # DQBUF
            return self._next()
        if command in (18, 19, 22, 39):  # STREAMON, STREAMOFF, S_PARM, S_INPUT
            return b""
        raise OSError(errno.EINVAL, "not offered")

    def _buffer(self, index: int, used: int) -> bytes:
        time_s = time.monotonic()
        return struct.pack(
            "IIIIIxxxxqq16xIIIII",
            index, CAPTURE, used, 1, 1, int(time_s), int(time_s % 1 * 1e6), self._number, MEMORY_MAP,
            index * PAGE, 0, PAGE,
        )  # fmt: skip

    def _next(self) -> bytes:
        if self.stalled.is_set():
            self.gone.wait()
            raise OSError(errno.ENODEV, "unplugged")
        if not self._queued:
            raise OSError(errno.EAGAIN, "no buffer")
        self._due_s = max(self._due_s + 0.01, time.monotonic() - 0.1)
        self.gone.wait(max(self._due_s - time.monotonic(), 0))
        index = self._queued.pop(0)
        os.pwrite(self._memory, bytes([self._number % 256]) * (COLUMNS * ROWS), index * PAGE)
        self._number += 1
        return self._buffer(index, COLUMNS * ROWS)


testbed = UMockdev.Testbed.new()
testbed.add_from_string(DEVICE)
camera = Camera(f"{testbed.get_root_dir()}/dev/video0")
handler = UMockdev.IoctlBase()
handler.connect("handle-ioctl", camera.answer)
testbed.attach_ioctl("/dev/video0", handler)
loop = GLib.MainLoop()
threading.Thread(target=loop.run, daemon=True).start()
with subprocess.Popen(
    [sys.argv[1], "-c", sys.argv[2]],
    stdout=subprocess.PIPE,
    text=True,
    env=os.environ | {"UMOCKDEV_DIR": testbed.get_root_dir()},
) as child:
    for line in child.stdout:
        if line == "!stall\n":
            camera.stalled.set()
        elif line == "!unplug\n":
            camera.gone.set()
        else:
            sys.stdout.write(line)
            sys.stdout.flush()
camera.gone.set()
loop.quit()
shutil.rmtree(testbed.get_root_dir(), ignore_errors=True)
sys.exit(child.returncode)
