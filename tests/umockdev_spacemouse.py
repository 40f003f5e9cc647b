"""A SpaceMouse on /dev/hidraw0 under umockdev, for a child process that opens it with the real hidapi.

Run as `umockdev-wrapper /usr/bin/python3 umockdev_spacemouse.py PYTHON CODE`: the system's Python has the
bindings, the project's runs the code. Each line the child prints lets the next report out; after the last one
the device is unplugged.
"""

import os
import struct
import subprocess
import sys
import threading

import gi

gi.require_version("UMockdev", "1.0")
from gi.repository import GLib, UMockdev  # noqa: E402

DESCRIPTOR = bytes.fromhex("05010908a101c0")  # a multi-axis controller, nothing more
SIZE, CONTENT = 0x80044801, 0x90044802  # HIDIOCGRDESCSIZE, HIDIOCGRDESC
HID = "/devices/pci0000:00/0000:00:14.0/usb1/1-1/1-1:1.0/0003:256F:C635.0001"
DEVICES = f"""P: /devices/pci0000:00/0000:00:14.0/usb1/1-1
N: bus/usb/001/002
E: DEVTYPE=usb_device
E: SUBSYSTEM=usb
A: idVendor=256f
A: idProduct=c635
A: bcdDevice=0100
A: manufacturer=3Dconnexion
A: product=SpaceMouse Compact
A: busnum=1
A: devnum=2

P: /devices/pci0000:00/0000:00:14.0/usb1/1-1/1-1:1.0
E: DEVTYPE=usb_interface
E: SUBSYSTEM=usb
A: bInterfaceNumber=00

P: {HID}
E: SUBSYSTEM=hid
E: HID_ID=0003:0000256F:0000C635
E: HID_NAME=3Dconnexion SpaceMouse Compact
E: HID_UNIQ=

P: {HID}/hidraw/hidraw0
N: hidraw0
E: DEVNAME=/dev/hidraw0
E: SUBSYSTEM=hidraw
L: device=../../../0003:256F:C635.0001
"""


def answer(_handler, client) -> bool:
    request = client.get_request()
    argument = client.get_arg()
    if request == SIZE:
        argument.resolve(0, 4).update(0, struct.pack("<i", len(DESCRIPTOR)))
    elif request == CONTENT:
        argument.resolve(0, 4 + 4096).update(4, DESCRIPTOR)
    else:
        return False
    client.complete(0, 0)
    return True


testbed = UMockdev.Testbed.new()
testbed.add_from_string(DEVICES)
testbed.set_attribute_binary(f"/sys{HID}", "report_descriptor", list(DESCRIPTOR))
handler = UMockdev.IoctlBase()
handler.connect("handle-ioctl", answer)
testbed.attach_ioctl("/dev/hidraw0", handler)
loop = GLib.MainLoop()
threading.Thread(target=loop.run, daemon=True).start()
with subprocess.Popen(
    [sys.argv[1], "-c", sys.argv[2]],
    stdout=subprocess.PIPE,
    text=True,
    env=os.environ | {"UMOCKDEV_DIR": testbed.get_root_dir()},
) as child:
    speaking = testbed.get_dev_fd("/dev/hidraw0")
    reports = [struct.pack("<B3h", 1, 0, 0, 0), struct.pack("<B3h", 1, 350, -350, 0)]
    for line in child.stdout:
        sys.stdout.write(line)
        sys.stdout.flush()
        if reports:
            os.write(speaking, reports.pop(0))
        elif speaking >= 0:
            os.close(speaking)  # the cable is drawn
            speaking = -1
loop.quit()
sys.exit(child.returncode)
