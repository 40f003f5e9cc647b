"""A GCS controller on native USB under umockdev, for a child process that opens it with the real libusb.

Run as `umockdev-wrapper /usr/bin/python3 umockdev_gcs.py PYTHON CODE`, with the drivers on PYTHONPATH: the
system's Python has the bindings, the project's runs the code. When the child prints "unplug" the device is
gone from its next request on, at "plug" it is back.
"""

import errno
import os
import struct
import subprocess
import sys
import threading
import time

import gi

gi.require_version("UMockdev", "1.0")
from gi.repository import GLib, UMockdev  # noqa: E402

from adof_drivers.emulators.gcs import GcsEngine  # noqa: E402

NODE = "/dev/bus/usb/001/002"
DESCRIPTORS = (
    bytes.fromhex(
        "12 01 0002 00 00 00 40 721a 0310 0001 00 00 00 01"  # 1a72:1003
        "09 02 2000 01 01 00 80 32  09 04 00 00 02 ff 00 00 00"
        "07 05 81 02 4000 00  07 05 02 02 4000 00"  # bulk in and out, 64 bytes
    )
    .hex()
    .upper()
)
DEVICES = f"""P: /devices/pci0000:00/0000:00:14.0/usb1/1-1
N: bus/usb/001/002={DESCRIPTORS}
H: descriptors={DESCRIPTORS}
E: DEVNAME=/dev/bus/usb/001/002
E: DEVTYPE=usb_device
E: SUBSYSTEM=usb
E: BUSNUM=001
E: DEVNUM=002
A: busnum=1
A: devnum=2
A: speed=12
A: bConfigurationValue=1
A: idVendor=1a72
A: idProduct=1003
"""
# linux/usbdevice_fs.h
GET_CAPABILITIES, GET_DRIVER, SET_CONFIGURATION = 0x8004551A, 0x41045508, 0x80045505
CLAIM, RELEASE, SUBMIT, REAP, DISCARD = 0x8004550F, 0x80045510, 0x8038550A, 0x4008550D, 0x550B
URB = struct.Struct("BBiIPiiiiiIP")
STATUS, BUFFER, ACTUAL_LENGTH = 4, 16, 28
PACKET = 64


class Device:
    """Answers the kernel's requests; URBs wait here until they are reaped."""

    def __init__(self) -> None:
        self.engine = GcsEngine(("1", "2"), now_s=time.monotonic)
        self.plugged = True
        self.claimed = False
        self._to_send = b""
        self._waiting: list = []  # IN, nothing to give yet
        self._done: list = []  # to be reaped, each with its status

    def answer(self, _handler, client) -> bool:
        request, argument = client.get_request(), client.get_arg()
        if not self.plugged:
            client.complete(-1, errno.ENODEV)
        elif request == GET_CAPABILITIES:
            argument.resolve(0, 4).update(0, struct.pack("<I", 0))
            client.complete(0, 0)
        elif request == GET_DRIVER:
            client.complete(-1, errno.ENODATA)
        elif request == CLAIM:
            client.complete(*((-1, errno.EBUSY) if self.claimed else (0, 0)))
            self.claimed = True
        elif request in (RELEASE, SET_CONFIGURATION):
            self.claimed &= request != RELEASE
            client.complete(0, 0)
        elif request == SUBMIT:
            self._submit(argument)
            client.complete(0, 0)
        elif request == DISCARD:
            # libusb has one IN URB under way at most.
            self._done += [(urb, buffer, -errno.ENOENT, b"") for urb, buffer, _ in self._waiting]
            self._waiting.clear()
            client.complete(0, 0)
        elif request == REAP:
            self._reap(client, argument)
        else:
            return False
        return True

    def _submit(self, argument) -> None:
        urb = argument.resolve(0, URB.size)
        _, endpoint, _, _, _, length, *_ = URB.unpack(bytes(urb.retrieve()))
        buffer = urb.resolve(BUFFER, length)
        if endpoint & 0x80:
            self._waiting.append((urb, buffer, length))
        else:
            self._to_send += b"".join(reply.data for reply in self.engine.feed(bytes(buffer.retrieve())))
            self._done.append((urb, buffer, 0, length))

    def _reap(self, client, argument) -> None:
        while self._waiting and self._to_send:
            urb, buffer, length = self._waiting.pop(0)
            size = min(length, PACKET)
            piece, self._to_send = self._to_send[:size], self._to_send[size:]
            self._done.append((urb, buffer, 0, piece))
        if not self._done:
            client.complete(-1, errno.EAGAIN)
            return
        urb, buffer, status, moved = self._done.pop(0)
        if isinstance(moved, bytes):
            buffer.update(0, moved)
            moved = len(moved)
        urb.update(STATUS, struct.pack("<i", status))
        urb.update(ACTUAL_LENGTH, struct.pack("<i", moved))
        argument.resolve(0, 8).set_ptr(0, urb)
        client.complete(0, 0)


device = Device()
testbed = UMockdev.Testbed.new()
testbed.add_from_string(DEVICES)
handler = UMockdev.IoctlBase()
handler.connect("handle-ioctl", device.answer)
testbed.attach_ioctl(NODE, handler)
loop = GLib.MainLoop()
threading.Thread(target=loop.run, daemon=True).start()
with subprocess.Popen(
    [sys.argv[1], "-c", sys.argv[2]],
    stdout=subprocess.PIPE,
    stdin=subprocess.PIPE,
    text=True,
    env=os.environ | {"UMOCKDEV_DIR": testbed.get_root_dir()},
) as child:
    for line in child.stdout:
        sys.stdout.write(line)
        sys.stdout.flush()
        device.plugged = {"unplug": False, "plug": True}.get(line.strip(), device.plugged)
        device.claimed &= device.plugged
        child.stdin.write("done\n")
        child.stdin.flush()
loop.quit()
sys.exit(child.returncode)
