"""Emulated HID devices on /dev/hidraw*, for a program that opens them with the real hidapi.

    umockdev-wrapper /usr/bin/python3 hid_nodes.py KINDS [--script FILE | --seed N] -- PROGRAM [ARGUMENT...]

KINDS, separated by commas, are plugged in, and PROGRAM runs with them. Lines of the script (`-`: standard
input), or those that the seed draws, are obeyed one by one:

    wait SECONDS
    KIND unplug | KIND plug        a device that was plugged in again is a new one, with the next number
    KIND COMMAND [ARGUMENT...]     what happens to the device, as in `hid`

Where a device was plugged in, and what the program made of it, is said on standard error. umockdev answers
the kernel's hidraw interface; its bindings belong to the system's Python, so this file needs nothing else.
"""

from __future__ import annotations

import errno
import fcntl
import math
import os
import select
import shutil
import signal
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

if __name__ == "__main__":  # run as a file, by a Python that does not know us
    sys.path.append(str(Path(__file__).parents[2]))

from adof_drivers.emulators.hid import KINDS, EmulatedHid, operator
from adof_drivers.errors import DriverError, RequestError

_SYSTEM_PYTHON = "/usr/bin/python3"
_DESCRIPTOR_SIZE, _DESCRIPTOR = 0x80044801, 0x90044802  # HIDIOCGRDESCSIZE, HIDIOCGRDESC
_HID, _SET_FEATURE, _GET_FEATURE = 0x48, 0x06, 0x07
_TERMINAL_NUMBER = 0x80045430  # TIOCGPTN
_TICK_S = 0.016


def command(
    kinds: Sequence[str], program: Sequence[str], *, script: str | None = None, seed: int | None = None
) -> list[str]:
    """Return the command that runs `program` among devices of these kinds.

    What happens to them is read from `script`, "-" for standard input, or drawn from `seed`; without either
    they are at rest.

    Raises
    ------
    RequestError
        An unknown kind, one twice, no program, or a line in `script` that cannot be obeyed.
    DriverError
        umockdev is not installed.
    """
    if not kinds or not set(kinds) <= set(KINDS) or len(set(kinds)) < len(kinds):
        raise RequestError(
            f"'{','.join(kinds)}' was asked for: of {', '.join(KINDS)} some, each once, were wanted"
        )
    if not program:
        raise RequestError(
            "no program was given: the devices are only there for the one that is run with them"
        )
    if script is not None and seed is not None:
        raise RequestError("a script and a seed were given: one of them says what happens to the devices")
    if script not in (None, "-"):
        _rehearse(Path(str(script)), kinds)
    bindings = "import gi; gi.require_version('UMockdev', '1.0'); from gi.repository import UMockdev"
    if (
        shutil.which("umockdev-wrapper") is None
        or not Path(_SYSTEM_PYTHON).exists()
        or subprocess.run(  # noqa: S603  (constants)
            [_SYSTEM_PYTHON, "-c", bindings], capture_output=True, check=False
        ).returncode
    ):
        raise DriverError(
            "HID devices are emulated by umockdev, which is not installed: "
            "apt install umockdev gir1.2-umockdev-1.0 python3-gi"
        )
    told = ["--script", script] if script is not None else ["--seed", str(seed)] if seed is not None else []
    return ["umockdev-wrapper", _SYSTEM_PYTHON, str(Path(__file__)), ",".join(kinds), *told, "--", *program]


def _rehearse(script: Path, kinds: Sequence[str]) -> None:
    """Refuse a script with a line that nobody could obey."""
    try:
        lines = script.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as failure:
        raise RequestError(f"{script} cannot be read ({failure}): give a script of commands") from None
    for number, line in enumerate(lines, 1):
        kind, *words = line.split() or ["wait", "0"]
        try:
            if kind == "wait":
                _duration_s(words)
            elif kind not in kinds:
                raise RequestError(f"{kind!r} is no device here: wait, {' or '.join(kinds)} was wanted")
            elif words not in (["plug"], ["unplug"]):
                KINDS[kind]().obey(words)
        except RequestError as failure:
            raise RequestError(f"{script}, line {number}: {failure}") from None


def _duration_s(words: Sequence[str]) -> float:
    try:
        (duration_s,) = map(float, words)
    except ValueError:
        duration_s = math.nan
    if not 0 <= duration_s < math.inf:
        raise RequestError(f"'wait {' '.join(words)}': 0 or more seconds were wanted")
    return duration_s


class _Node:
    """One device on its node: a pseudo terminal, as umockdev makes it, whose ioctls `_answer` answers."""

    def __init__(self, testbed: Any, umockdev: Any, kind: str, number: int) -> None:
        self.device: EmulatedHid = KINDS[kind]()
        self.kind = kind
        self.path = f"/dev/hidraw{number}"
        self._testbed = testbed
        self._descriptor = self.device.USAGE + bytes.fromhex("a101c0")
        self._gone = False
        self._said = self.device.state()
        usb = f"/devices/pci0000:00/0000:00:14.0/usb1/1-{number + 1}"
        vendor, product = self.device.IDENTITY
        hid = f"{usb}/1-{number + 1}:1.0/0003:{vendor:04X}:{product:04X}.{number + 1:04X}"
        self._places = [
            f"/sys{place}" for place in (f"{hid}/hidraw/hidraw{number}", hid, Path(hid).parent, usb)
        ]
        self._handler = umockdev.IoctlBase()
        self._handler.connect("handle-ioctl", self._answer)
        self._say(f"plugged in at {self.path}")
        testbed.attach_ioctl(self.path, self._handler)  # first, for a program opens what it sees
        testbed.add_from_string(_description(self.device, number, usb, hid))
        testbed.set_attribute_binary(f"/sys{hid}", "report_descriptor", list(self._descriptor))
        self.host = testbed.get_dev_fd(self.path)
        terminal = struct.unpack("i", fcntl.ioctl(self.host, _TERMINAL_NUMBER, bytes(4)))[0]
        self._program = os.open(f"/dev/pts/{terminal}", os.O_RDONLY | os.O_NOCTTY)

    def _answer(self, _handler: Any, client: Any) -> bool:
        request = client.get_request() & 0xFFFFFFFF
        argument = client.get_arg()
        if self._gone:
            client.complete(-1, errno.ENODEV)
        elif request == _DESCRIPTOR_SIZE:
            argument.resolve(0, 4).update(0, struct.pack("<i", len(self._descriptor)))
            client.complete(0, 0)
        elif request == _DESCRIPTOR:
            argument.resolve(0, 4 + 4096).update(4, self._descriptor)
            client.complete(0, 0)
        elif request >> 8 & 0xFF == _HID and request & 0xFF in (_SET_FEATURE, _GET_FEATURE):
            count = request >> 16 & 0x3FFF
            content = argument.resolve(0, count)
            if request & 0xFF == _SET_FEATURE:
                done = self.device.send_feature_report(bytes(content.retrieve()))
            else:
                reply = bytes(self.device.get_feature_report(content.retrieve()[0], count))
                content.update(0, reply)
                done = len(reply)
            self._tell()
            client.complete(done, 0 if done >= 0 else errno.EPIPE)
        else:
            return False
        return True

    def pump(self) -> None:
        """Hand the next report out once the last one was read: a pseudo terminal would join them."""
        if not select.select([self._program], [], [], 0)[0]:
            report = bytes(self.device.read(64))
            if report:
                os.write(self.host, report)
        if select.select([self.host], [], [], 0)[0]:
            came = os.read(self.host, self.device.OUTPUT_BYTES)
            self.device.write(came)
            self._tell()

    def unplug(self) -> None:
        self._gone = True
        Path(self._testbed.get_root_dir() + self.path).unlink()
        for place in self._places:
            self._testbed.uevent(place, "remove")
            self._testbed.remove_device(place)
        os.close(self._program)
        os.close(self.host)
        self._say("unplugged")

    def _tell(self) -> None:
        state = self.device.state()
        if state != self._said:
            self._said = state
            self._say(state)

    def _say(self, what: str) -> None:
        sys.stderr.write(f"{self.kind}: {what}\n")
        sys.stderr.flush()


def _description(device: EmulatedHid, number: int, usb: str, hid: str) -> str:
    """What sysfs says of the device, in umockdev's form."""
    vendor, product = device.IDENTITY
    return f"""P: {usb}
N: bus/usb/001/{number + 2:03}
E: DEVTYPE=usb_device
E: SUBSYSTEM=usb
A: idVendor={vendor:04x}
A: idProduct={product:04x}
A: bcdDevice=0100
A: manufacturer=emulated
A: product={device.PRODUCT}
A: busnum=1
A: devnum={number + 2}

P: {Path(hid).parent}
E: DEVTYPE=usb_interface
E: SUBSYSTEM=usb
A: bInterfaceNumber=00

P: {hid}
E: SUBSYSTEM=hid
E: HID_ID=0003:{vendor:08X}:{product:08X}
E: HID_NAME=emulated {device.PRODUCT}
E: HID_UNIQ=

P: {hid}/hidraw/hidraw{number}
N: hidraw{number}
E: DEVNAME=/dev/hidraw{number}
E: SUBSYSTEM=hidraw
L: device=../../../{Path(hid).name}
"""


class _Bus:
    """The devices plugged in, by kind; commands and reports take turns."""

    def __init__(self, kinds: Iterable[str]) -> None:
        import gi

        gi.require_version("UMockdev", "1.0")
        from gi.repository import GLib, UMockdev

        self._umockdev = UMockdev
        self.testbed = UMockdev.Testbed.new()
        self.loop = GLib.MainLoop()
        self._lock = threading.Lock()
        self._numbers = 0
        self._nodes: dict[str, _Node] = {}
        for kind in kinds:
            self.plug(kind)

    def plug(self, kind: str) -> None:
        self._nodes[kind] = _Node(self.testbed, self._umockdev, kind, self._numbers)
        self._numbers += 1

    def obey(self, line: str) -> None:
        """Do what a line says; one that is not understood is told and skipped."""
        words = line.split()
        if not words:
            return
        if words[0] == "wait":
            time.sleep(_duration_s(words[1:]))
            return
        with self._lock:
            node = self._nodes.get(words[0])
            if words[1:] == ["plug"] and words[0] in KINDS and node is None:
                self.plug(words[0])
            elif node is None:
                raise RequestError(f"'{line.strip()}': {words[0]} is not plugged in")
            elif words[1:] == ["unplug"]:
                del self._nodes[words[0]]
                node.unplug()
            else:
                node.device.obey(words[1:])

    def serve(self) -> None:
        """Pass reports on, for ever."""
        repeated_s = time.monotonic()
        while True:
            now_s = time.monotonic()
            with self._lock:
                for node in self._nodes.values():
                    if now_s - repeated_s >= _TICK_S:
                        node.device.repeat()
                    node.pump()
            if now_s - repeated_s >= _TICK_S:
                repeated_s = now_s
            time.sleep(0.001)


def _play(bus: _Bus, lines: Iterable[str]) -> None:
    for line in lines:
        try:
            bus.obey(line)
        except RequestError as failure:
            sys.stderr.write(f"{failure}\n")
            sys.stderr.flush()


def main(arguments: list[str]) -> int:
    """Run the program among the devices; its exit code is ours."""
    kinds, *told = arguments[: arguments.index("--")]
    program = arguments[arguments.index("--") + 1 :]
    match told:
        case ["--seed", seed]:
            lines = operator(kinds.split(","), int(seed))
        case ["--script", script]:
            # Unbuffered: whoever waits in a buffer's read must not be left behind at the end.
            source = open(0 if script == "-" else script, "rb", buffering=0)  # noqa: SIM115, PTH123
            lines = (line.decode() for line in source)
        case _:
            lines = iter(())
    bus = _Bus(kinds.split(","))
    for work in (bus.loop.run, bus.serve):
        threading.Thread(target=work, daemon=True).start()
    child = subprocess.Popen(  # noqa: S603  (the user's own program)
        program,
        stdin=subprocess.DEVNULL if told == ["--script", "-"] else None,
        env=os.environ | {"UMOCKDEV_DIR": bus.testbed.get_root_dir()},
    )
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # a terminal tells the program too
    signal.signal(signal.SIGTERM, lambda *_: child.terminate())
    threading.Thread(target=_play, args=(bus, lines), daemon=True).start()
    code = child.wait()
    bus.loop.quit()
    shutil.rmtree(bus.testbed.get_root_dir(), ignore_errors=True)
    return code if code >= 0 else 128 - code


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
