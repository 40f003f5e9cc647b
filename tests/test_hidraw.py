"""The real hidapi on emulated device nodes: the kernel's hidraw interface, answered by umockdev."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from ctypes.util import find_library
from importlib.util import find_spec
from itertools import islice
from pathlib import Path

import pytest

from adof_cl.cli import main
from adof_drivers.emulators.hid import KINDS, operator
from adof_drivers.emulators.hid_nodes import command
from adof_drivers.errors import DriverError, RequestError

PROGRAM = """
import subprocess, sys, time
from adof_drivers.errors import DriverError
from adof_drivers.pedal import StopPedal
from adof_drivers.relay import HidRelay
from adof_drivers.spacemouse import SpaceMouse

REST = (0.0,) * 6

def until(device, wanted):
    ends_s = time.monotonic() + 10
    while not wanted(state := device.poll()):
        assert time.monotonic() < ends_s, state
    return state

def for_(duration_s, device, wanted):
    ends_s = time.monotonic() + duration_s
    while time.monotonic() < ends_s:
        assert wanted(state := device.poll()), state

def plugged_in_again(open_):
    ends_s = time.monotonic() + 10
    while True:
        try:
            return open_()
        except DriverError:
            assert time.monotonic() < ends_s

def failure_of(ask):
    ends_s = time.monotonic() + 10
    while True:
        try:
            ask()
        except DriverError as failure:
            return str(failure)
        assert time.monotonic() < ends_s

def refusal(ask):
    try:
        ask()
    except DriverError as failure:
        return str(failure)
    raise AssertionError("it was not refused")

def say(*words):
    print(*words, flush=True)
"""


def installed() -> bool:
    try:
        command(["relay"], ["true"])
    except DriverError:
        return False
    return True


needs_umockdev = pytest.mark.skipif(
    not installed(), reason="umockdev with its Python bindings is not installed"
)


class Session:
    """A program among devices: what it says, and what is done to them."""

    def __init__(self, process: subprocess.Popen[str]) -> None:
        self._process = process

    def says(self, line: str) -> None:
        assert self._process.stdout is not None
        came = self._process.stdout.readline().rstrip("\n")
        if came != line:
            raise AssertionError(f"{came!r} came, {line!r} was wanted\n{self._process.communicate()[1]}")

    def do(self, *lines: str) -> None:
        assert self._process.stdin is not None
        self._process.stdin.write("".join(f"{line}\n" for line in lines))
        self._process.stdin.flush()

    def ends(self) -> list[str]:
        """What the devices noticed, line by line."""
        _, said = self._process.communicate(timeout=60)
        assert self._process.returncode == 0, said
        return said.splitlines()


@contextmanager
def session(kinds: list[str], code: str) -> Iterator[Session]:
    with subprocess.Popen(
        command(kinds, [sys.executable, "-c", PROGRAM + code], script="-"),
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    ) as process:
        try:
            yield Session(process)
        finally:
            process.kill()


@needs_umockdev
def test_a_spacemouse_unplugged_while_deflected_rests_and_moves_nothing_when_it_is_back() -> None:
    code = """
mouse = SpaceMouse.open()
for_(0.25, mouse, lambda state: state.axes == REST)
say("rest")
say("pushed", until(mouse, lambda state: state.axes[0]).axes)
gone = until(mouse, lambda state: not state.connected)
say("unplugged", gone.axes == REST)
say(refusal(SpaceMouse.open).partition(" (")[0])
again = plugged_in_again(SpaceMouse.open)
for_(0.3, again, lambda state: state.axes == REST and state.connected)
for_(0.01, mouse, lambda state: state.axes == REST and not state.connected)
say("plugged in while pushed, and at rest")
say("pushed", until(again, lambda state: state.axes[0]).axes)
again.set_light(on=True)
again.close()
"""
    with session(["spacemouse"], code) as devices:
        devices.says("rest")
        devices.do("spacemouse deflect 350 -350 0")
        devices.says("pushed (1.0, -1.0, 0.0, 0.0, 0.0, 0.0)")
        devices.do("spacemouse unplug")
        devices.says("unplugged True")
        devices.says("no SpaceMouse is connected")
        devices.do("spacemouse plug", "spacemouse deflect 350 350 350 350 350 350")
        devices.says("plugged in while pushed, and at rest")
        devices.do("spacemouse deflect 0 0 0", "wait 0.1", "spacemouse deflect 350 0 0")
        devices.says("pushed (1.0, 0.0, 0.0, 0.0, 0.0, 0.0)")
        assert devices.ends() == [
            "spacemouse: plugged in at /dev/hidraw0",
            "spacemouse: unplugged",
            "spacemouse: plugged in at /dev/hidraw1",
            "spacemouse: light on",
        ]


@needs_umockdev
@pytest.mark.parametrize(("kind", "form"), [("pedal", "joystick"), ("keyboard-pedal", "keyboard")])
def test_a_pedal_stops_when_pressed_and_when_unplugged_until_it_is_opened_again(kind: str, form: str) -> None:
    code = f"""
pedal = StopPedal.open(form={form!r})
for_(0.05, pedal, lambda state: not state.stop)
say("free")
until(pedal, lambda state: state.stop)
say("stop")
say("free again", until(pedal, lambda state: not state.stop).tested)
say("gone", until(pedal, lambda state: not state.connected).stop)
again = plugged_in_again(lambda: StopPedal.open(form={form!r}))
for_(0.05, pedal, lambda state: state.stop and not state.connected)
state = again.poll()
say("opened again", state.stop, state.tested)
again.close()
"""
    with session([kind], code) as devices:
        devices.says("free")
        devices.do(f"{kind} press")
        devices.says("stop")
        devices.do(f"{kind} release")
        devices.says("free again True")
        devices.do(f"{kind} unplug")
        devices.says("gone True")
        devices.do(f"{kind} plug")
        devices.says("opened again False False")
        devices.ends()


@needs_umockdev
def test_a_relay_that_sticks_or_goes_is_told_and_is_off_when_plugged_in_again() -> None:
    code = """
relay = HidRelay.open()
relay.switch(1, on=True)
say(relay.channels, relay.state())

def switch():
    relay.switch(0, on=True)
    relay.switch(0, on=False)

say(failure_of(switch)[:22])
say(failure_of(relay.state).partition(" (")[0])
relay.close()
again = plugged_in_again(HidRelay.open)
say(again.state())
again.switch(1, on=True)
again.close()
"""
    with session(["relay"], code) as devices:
        devices.says("2 (False, True)")
        devices.do("relay stick 0 1")
        devices.says("relay 0 did not switch")
        devices.do("relay unplug")
        devices.says("the USB relay was unplugged")
        devices.do("relay plug")
        devices.says("(False, False)")
        noticed = devices.ends()
        assert noticed[-2:] == ["relay: on 1", "relay: all off"]  # closed: off


@needs_umockdev
def test_another_device_on_a_port_is_named_and_nothing_is_sent_to_it() -> None:
    code = """
say(refusal(lambda: HidRelay.open("/dev/hidraw0")))
say(refusal(lambda: SpaceMouse.open("/dev/hidraw1")).partition(" (")[0])
say(refusal(lambda: StopPedal.open("/dev/hidraw2")).partition(" (")[0])
say(refusal(lambda: StopPedal.open("/dev/hidraw7")).partition(" (")[0])
from adof_drivers import hid_device, pedal, spacemouse
either = spacemouse.IDENTITIES | pedal.JOYSTICK_IDENTITIES
say(refusal(lambda: hid_device.open_hid("jog or pedal", either)))
"""
    with session(["spacemouse", "pedal", "relay"], code) as devices:
        devices.says(
            "at /dev/hidraw0 is 256f:c635 'SpaceMouse Compact', no USB relay (16c0:05df): name another path"
        )
        devices.says("at /dev/hidraw1 is 05f3:00ff 'VEC Footpedal', no SpaceMouse")
        devices.says("at /dev/hidraw2 is 16c0:05df 'USBRelay2', no foot pedal")
        devices.says("/dev/hidraw7 cannot be opened")
        devices.says(
            "several devices are a jog or pedal: /dev/hidraw0, /dev/hidraw1; name one of these paths"
        )
        assert all("plugged in" in line for line in devices.ends())


@needs_umockdev
def test_a_second_program_is_refused_and_the_first_goes_on() -> None:
    code = """
relay, mouse = HidRelay.open(), SpaceMouse.open()
relay.switch(0, on=True)
other = "from adof_drivers.KIND import CLASS; CLASS.open()"
for kind, name in (("relay", "HidRelay"), ("spacemouse", "SpaceMouse")):
    ran = subprocess.run(
        [sys.executable, "-c", other.replace("KIND", kind).replace("CLASS", name)],
        capture_output=True,
        text=True,
    )
    say(ran.stderr.splitlines()[-1].partition(": ")[2])
say(relay.state())
for_(0.25, mouse, lambda state: state.connected)
say("first")
until(mouse, lambda state: state.axes[0] == 1)
for device in (relay, mouse):
    device.close()
HidRelay.open().close()
"""
    with session(["relay", "spacemouse"], code) as devices:
        for number in (0, 1):
            devices.says(f"/dev/hidraw{number} is held by another program: close that one")
        devices.says("(True, False)")
        devices.says("first")
        devices.do("spacemouse deflect 350 0 0")
        devices.ends()


OTHER_CLIENT = """
import time, warnings
warnings.simplefilter("ignore")
import pyspacemouse

device = pyspacemouse.open()
print("opened", flush=True)
before = None
while before is None or not before[-1][1]:
    state = device.read()
    now = [round(value, 3) for value in (state.x, state.y, state.z, state.roll, state.pitch, state.yaw)]
    now.append(tuple(state.buttons))
    if now != before:
        print(now, flush=True)
    before = now
"""


@needs_umockdev
@pytest.mark.skipif(
    find_spec("pyspacemouse") is None or find_library("hidapi-hidraw") is None,
    reason="pyspacemouse or its libhidapi is not installed",
)
def test_pyspacemouse_finds_the_emulated_puck_and_reads_what_was_pushed() -> None:
    with session(["spacemouse"], OTHER_CLIENT) as devices:
        devices.says("SpaceMouseCompact found")
        devices.says("opened")
        devices.says("[0.0, 0.0, 0.0, 0.0, 0.0, 0.0, (0, 0)]")
        # Its signs are its own: y and z are the other way round.
        for pushed, read in (
            ("350 0 0 0 0 0", "[1.0, 0.0, 0.0, 0.0, 0.0, 0.0, (0, 0)]"),
            ("0 -175 0 0 0 0", "[0.0, 0.5, 0.0, 0.0, 0.0, 0.0, (0, 0)]"),
            ("0 0 -70 0 0 0", "[0.0, 0.0, 0.2, 0.0, 0.0, 0.0, (0, 0)]"),
            ("0 0 0 0 0 350", "[0.0, 0.0, 0.0, 0.0, 0.0, 1.0, (0, 0)]"),
        ):
            devices.do("spacemouse deflect 0 0 0", f"spacemouse deflect {pushed}")
            if pushed[:3] != "350":
                devices.says("[0.0, 0.0, 0.0, 0.0, 0.0, 0.0, (0, 0)]")
            devices.says(read)
        devices.do("spacemouse deflect 0 0 0", "spacemouse press 1")
        devices.says("[0.0, 0.0, 0.0, 0.0, 0.0, 0.0, (0, 0)]")
        devices.says("[0.0, 0.0, 0.0, 0.0, 0.0, 0.0, (0, 1)]")
        devices.ends()


@needs_umockdev
def test_the_command_runs_a_program_among_devices_and_passes_its_exit_code_on(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    script = tmp_path / "script"
    script.write_text("wait 0\npedal press\n", encoding="utf-8")
    code = (
        PROGRAM
        + "until(StopPedal.open(), lambda state: state.stop); print(refusal(SpaceMouse.open)); sys.exit(7)"
    )
    with pytest.raises(SystemExit) as exit_:
        main(["emulate", "hid", "pedal", "--script", str(script), "--", sys.executable, "-c", code])
    assert exit_.value.code == 7
    said, noticed = capfd.readouterr()
    assert said.startswith("no SpaceMouse is connected")
    assert noticed == "pedal: plugged in at /dev/hidraw0\n"


def test_what_is_no_command_is_refused_before_a_program_runs(tmp_path: Path) -> None:
    for line, said in (
        ("mouse deflect 1 2 3", "is no device here"),
        ("spacemouse deflect 1 2", "'deflect X Y Z"),
        ("spacemouse deflect 1 2 99999", "'deflect X Y Z"),
        ("spacemouse press -1", "'press"),
        ("spacemouse", "'report HEX'"),
        ("pedal report xy", "'report HEX'"),
        ("pedal release now", "'release'"),
        ("wait -1", "0 or more seconds"),
        ("wait", "0 or more seconds"),
    ):
        script = tmp_path / "script"
        script.write_text(f"wait 0.1\n\n{line}\n", encoding="utf-8")
        with pytest.raises(RequestError, match=f"line 3.*{said}"):
            command(["spacemouse", "pedal"], ["true"], script=str(script))
    for kinds, program, options in (
        (["mouse"], ["true"], {}),
        ([], ["true"], {}),
        (["relay", "relay"], ["true"], {}),
        (["relay"], [], {}),
        (["relay"], ["true"], {"seed": 1, "script": "-"}),
        (["relay"], ["true"], {"script": str(tmp_path / "none")}),
    ):
        with pytest.raises(RequestError):
            command(kinds, program, **options)  # type: ignore[arg-type]


@pytest.mark.parametrize("seed", range(3))
def test_a_seed_draws_the_same_commands_again_and_every_one_can_be_obeyed(seed: int) -> None:
    lines = list(islice(operator(list(KINDS), seed), 200))
    assert lines == list(islice(operator(list(KINDS), seed), 200))
    for kind, *words in map(str.split, lines):
        if kind != "wait" and words not in (["plug"], ["unplug"]):
            KINDS[kind]().obey(words)
    assert any("unplug" in line for line in lines)
