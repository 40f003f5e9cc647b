"""GigE Vision down to the wire: our client and two others on the emulated camera, over loopback only."""

from __future__ import annotations

import os
import shutil
import socket
import subprocess
import sys
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from adof_drivers.camera import Frame, WatchedCamera
from adof_drivers.camera_pair import CameraPair
from adof_drivers.emulators.gige import Faults, GigeCameraEmulator, Region
from adof_drivers.emulators.gige_features import PIXEL_FORMATS
from adof_drivers.errors import DeviceLostError, DriverError, FrameTimeoutError, FrozenFramesError
from adof_drivers.gige import BlockNumbers, GigeCamera, answers, buffer_advice

pytestmark = pytest.mark.usefixtures("loopback_cameras")
SENSOR = (30, 41)  # odd, so that no line begins at a multiple of 4 bytes


def scene(number: int, region: Region, dtype: type = np.uint8) -> np.ndarray:
    whole = np.random.default_rng(number).integers(0, np.iinfo(dtype).max, SENSOR, dtype=dtype)
    (y, x), (rows, columns) = region
    return whole[y : y + rows, x : x + columns]


def whole(number: int, dtype: type = np.uint8) -> np.ndarray:
    return scene(number, ((0, 0), SENSOR), dtype)


needs_viva = pytest.mark.skipif(find_spec("viva_genicam") is None, reason="viva-genicam is not installed")


@pytest.fixture
def camera(loopback_cameras: None) -> Iterator[GigeCamera]:  # noqa: ARG001  (the address comes first)
    with GigeCameraEmulator(scene, SENSOR, rate_hz=100):
        opened = GigeCamera("127.0.0.1")
        yield opened
        opened.close()


def emulated(faults: Faults | None = None, rate_hz: float = 100) -> GigeCameraEmulator:
    return GigeCameraEmulator(scene, SENSOR, rate_hz=rate_hz, faults=faults)


@needs_viva
@pytest.mark.parametrize(
    ("pixel_format", "padding"),
    [(name, 0) for name in PIXEL_FORMATS] + [("Mono8", 3), ("Mono12", 3), ("Mono16", 3)],
)
def test_frames_arrive_bit_for_bit_with_the_stride_they_were_sent_with(
    pixel_format: str, padding: int
) -> None:
    depth = PIXEL_FORMATS[pixel_format][1]
    dtype = np.uint8 if depth == 8 else np.uint16

    def source(_number: int, region: Region) -> np.ndarray:
        return scene(0, region, dtype) >> (np.iinfo(dtype).bits - depth)

    with GigeCameraEmulator(source, SENSOR, pixel_format=pixel_format, line_padding=padding, rate_hz=200):
        camera = GigeCamera("127.0.0.1", packet_size=700)
        for region in (((0, 0), SENSOR), ((3, 2), (11, 13)), ((0, 0), (1, 1))):
            camera.configure(region=region)
            camera.start()
            for _ in range(2):
                frame = camera.grab()
                assert frame.complete
                assert frame.stride_bytes == region[1][1] * np.dtype(dtype).itemsize + padding
                np.testing.assert_array_equal(frame.pixels, source(0, region))
            camera.stop()
        camera.close()


@needs_viva
def test_times_are_of_the_exposure_and_never_after_the_arrival(camera: GigeCamera) -> None:
    camera.start()
    frames = [camera.grab() for _ in range(20)]
    for frame in frames:
        # The emulator's clock is the host's, so the carried time shows its error: half of a question and
        # answer at most, and a frame's way takes longer than that.
        assert frame.device_time_s is not None
        assert abs(frame.time_s - frame.device_time_s) < frame.received_s - frame.device_time_s
        assert frame.time_s <= frame.received_s
    apart_s = np.diff([frame.time_s for frame in frames])
    numbers = np.diff([frame.number for frame in frames])
    assert (numbers >= 1).all()
    assert (apart_s > 0).all()


@needs_viva
def test_a_region_is_cut_from_the_sensor_and_settings_are_read_back(camera: GigeCamera) -> None:
    settings = camera.configure(region=((4, 6), (11, 13)), exposure_s=0.002, rate_hz=50.0)
    assert (settings.origin_yx, settings.shape, settings.rate_hz) == ((4, 6), (11, 13), 50.0)
    assert settings.exposure_s == pytest.approx(0.002, rel=1e-6)  # a float32 on the wire
    camera.start()
    frame = camera.grab()
    assert frame.origin_yx == (4, 6)
    np.testing.assert_array_equal(frame.pixels, scene(frame.number - 1, ((4, 6), (11, 13))))


@needs_viva
def test_what_is_refused_changes_nothing(camera: GigeCamera) -> None:
    before = camera.settings
    for wrong in (
        {"region": ((20, 0), (11, 5))},
        {"exposure_s": -1.0},
        {"rate_hz": 0.0},
        {"trigger": "line 1"},
        {"rate_hz": 50.0, "exposure_s": 1e9},
    ):
        with pytest.raises(DriverError):
            camera.configure(**wrong)  # type: ignore[arg-type]
        assert camera.settings == before
    with pytest.raises(DriverError, match="start"):
        camera.grab()
    with pytest.raises(DriverError, match="runs freely"):
        camera.trigger()
    camera.start()
    with pytest.raises(DriverError, match="stop"):
        camera.configure(rate_hz=10)


@needs_viva
def test_a_software_trigger_gives_one_frame_each_and_none_without(camera: GigeCamera) -> None:
    camera.configure(trigger="software")
    camera.trigger()  # before the start: for nothing
    camera.start()
    with pytest.raises(FrameTimeoutError):
        camera.grab(0.05)
    for _ in range(3):
        camera.trigger()
        assert camera.grab().complete
    with pytest.raises(FrameTimeoutError):
        camera.grab(0.05)


@needs_viva
def test_acquisition_can_be_stopped_and_started_again(camera: GigeCamera) -> None:
    for _ in range(2):
        camera.start()
        assert camera.grab().complete
        camera.stop()


@needs_viva
def test_lost_packets_are_asked_for_again_and_the_frames_are_whole() -> None:
    with GigeCameraEmulator(scene, SENSOR, faults=Faults(seed=1, packet_loss=0.2)) as emulator:
        # Where the machine is busy, an answer may come too late: such a frame is torn, and not handed out.
        camera = WatchedCamera(GigeCamera("127.0.0.1", packet_size=600), policy="lossless")
        for frame in grab_for(camera, 20):
            np.testing.assert_array_equal(frame.pixels, whole(frame.number - 1))
        camera.close()
        assert emulator.resent > 0


def grab_until_it_fails(camera: GigeCamera | WatchedCamera | CameraPair) -> None:
    for _ in range(30):
        camera.grab(0.2)


def grab_for(camera: WatchedCamera, frames: int) -> list[Frame]:
    camera.start()
    return [camera.grab() for _ in range(frames)]


@needs_viva
def test_malformed_packets_are_refusals_or_torn_frames_never_another_picture_and_never_for_ever() -> None:
    opened, good, failures = 0, 0, 0
    for seed in range(1, 6):
        with GigeCameraEmulator(
            lambda _, region: scene(0, region),
            SENSOR,
            rate_hz=300,
            line_padding=40 * (seed % 2),  # else a frame is one packet
            faults=Faults(seed=seed, garbled=0.04),
        ):
            try:
                camera = GigeCamera("127.0.0.1", packet_size=576)
            except DriverError:
                continue
            try:
                camera.start()
                opened += 1
                for _ in range(30):
                    try:
                        frame = camera.grab(0.1)
                    except DriverError:
                        failures += 1
                    else:
                        if frame.complete:
                            good += 1
                            np.testing.assert_array_equal(frame.pixels, whole(0))
            except DriverError:  # start
                pass
            finally:
                camera.close()
    assert 0 < opened < 5
    assert good > 0
    assert failures > 0


@needs_viva
def test_a_camera_switched_off_and_on_again_is_lost_and_works_once_it_is_opened_again() -> None:
    with emulated():
        before = GigeCamera("127.0.0.1")
        before.start()
        assert before.grab().complete
    with emulated():
        with pytest.raises(DriverError):  # it answers, and knows nothing of us
            grab_until_it_fails(before)
        after = GigeCamera("127.0.0.1")
        after.start()
        assert after.grab().number == 1
        before.close()
        assert after.grab().complete
        after.close()


@needs_viva
def test_a_receive_buffer_that_is_too_small_is_told_with_what_to_do(
    camera: GigeCamera, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    limit = tmp_path / "rmem_max"
    monkeypatch.setattr("adof_drivers.gige._LARGEST_BUFFER", limit)
    frame_bytes = SENSOR[0] * SENSOR[1]
    assert buffer_advice(frame_bytes) is None  # a system without that file
    limit.write_text(f"{2 * frame_bytes}\n", encoding="ascii")
    assert buffer_advice(frame_bytes) is None
    limit.write_text("212992\n", encoding="ascii")
    assert "sysctl -w net.core.rmem_max=13631488" in str(buffer_advice(6_500_000))
    limit.write_text("2000\n", encoding="ascii")
    with pytest.warns(UserWarning, match=r"keep 2000 bytes, two frames have 2460.*rmem_max=4194304"):
        camera.start()
    assert camera.grab().complete


@needs_viva
def test_frames_that_were_not_sent_are_counted() -> None:
    faults = Faults(seed=2, frame_loss=0.3)
    with emulated(faults):
        camera = WatchedCamera(GigeCamera("127.0.0.1"), policy="lossless")
        frames = grab_for(camera, 20)
        sent = {n for n in range(frames[-1].number) if faults.draw(n).random(3)[0] >= 0.3}
        assert {frame.number - 1 for frame in frames} <= sent
        assert camera.counts.dropped == frames[-1].number - frames[0].number + 1 - len(frames) > 0
        camera.close()


@needs_viva
def test_frames_sent_out_of_order_are_not_handed_out() -> None:
    with emulated(Faults(seed=3, swapped=0.3)):
        camera = WatchedCamera(GigeCamera("127.0.0.1"), policy="lossless")
        numbers = [frame.number for frame in grab_for(camera, 20)]
        assert numbers == sorted(set(numbers))
        assert camera.counts.dropped > 0
        camera.close()


@needs_viva
def test_frames_on_their_way_for_too_long_are_not_handed_out() -> None:
    # Seed 67: the first frame is the quickest; three of the next six follow 65 to 81 ms late.
    with emulated(Faults(seed=67, delay_s=0.09), rate_hz=10):
        camera = WatchedCamera(GigeCamera("127.0.0.1"), policy="lossless", late_s=0.037)
        frames = grab_for(camera, 4)
        assert camera.counts.late > 0
        assert all(frame.received_s - frame.time_s <= 0.037 for frame in frames)
        camera.close()


@needs_viva
def test_a_frozen_camera_is_told_from_a_still_scene() -> None:
    with emulated(Faults(freeze_at=5)):
        camera = WatchedCamera(GigeCamera("127.0.0.1"), policy="lossless")
        camera.start()
        with pytest.raises(FrozenFramesError):
            grab_until_it_fails(camera)
        assert camera.counts.repeated == 3
        camera.close()


@needs_viva
def test_a_camera_that_stalls_times_out_and_one_that_is_unplugged_is_lost() -> None:
    with emulated(Faults(stall_at=3)) as emulator:
        camera = GigeCamera("127.0.0.1")
        camera.start()
        assert camera.grab().complete
        with pytest.raises(FrameTimeoutError):
            grab_until_it_fails(camera)
        with pytest.raises(FrameTimeoutError):
            camera.grab(0.05)
        emulator.unplug()
        with pytest.raises(DeviceLostError, match="no longer answers"):
            camera.grab(0.05)
        camera.close()
        camera.close()


@needs_viva
def test_a_second_program_cannot_take_a_camera_that_is_held(camera: GigeCamera) -> None:
    with pytest.raises(DriverError, match="another program holds it"):
        GigeCamera("127.0.0.1")
    camera.start()
    assert camera.grab().complete


@needs_viva
def test_a_camera_given_back_can_be_opened_again() -> None:
    with emulated() as emulator:
        for _ in range(2):
            camera = GigeCamera("127.0.0.1")
            assert emulator.controlled
            camera.close()
            assert not emulator.controlled


@needs_viva
def test_no_camera_at_an_address_says_so_and_names_those_there_are() -> None:
    with emulated(), pytest.raises(DriverError, match=r"127\.0\.0\.9 \(others found: 127\.0\.0\.1\)"):
        GigeCamera("127.0.0.9")
    assert not answers("127.0.0.9")


@needs_viva
def test_another_camera_than_wanted_is_refused_named_and_given_back(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    with emulated() as emulator:
        with pytest.raises(
            DriverError, match=r"at 127\.0\.0\.1 is camera 'EMU7f000001', 'EMU7f000002' was wanted"
        ):
            GigeCamera("127.0.0.1", serial="EMU7f000002")
        assert not emulator.controlled
        right = GigeCamera("127.0.0.1", serial="EMU7f000001")
        assert right.serial == "EMU7f000001"
        right.close()
    monkeypatch.setitem(PIXEL_FORMATS, "BayerRG8", (0x01080009, 8))
    with GigeCameraEmulator(scene, SENSOR, pixel_format="BayerRG8") as emulator:
        with pytest.raises(DriverError, match="sends BayerRG8: set it to one of Mono8, "):
            GigeCamera("127.0.0.1")
        assert not emulator.controlled


@needs_viva
def test_two_cameras_are_paired_and_the_one_that_is_lost_is_named() -> None:
    with (
        GigeCameraEmulator(scene, SENSOR, siblings=["127.0.0.2"]) as one,
        GigeCameraEmulator(scene, SENSOR, address="127.0.0.2") as two,
    ):
        pair = CameraPair(
            WatchedCamera(GigeCamera("127.0.0.1")),
            WatchedCamera(GigeCamera("127.0.0.2")),
            tolerance_s=1 / 120,
        )
        pair.start()
        for _ in range(10):
            both = pair.grab()
            assert abs(both.apart_s) <= 1 / 120
            assert both.frame_1.device_time_s is not None
            assert both.frame_2.device_time_s is not None
            # Emulated cameras keep step; their stamps are whole nanoseconds.
            periods = (both.frame_1.device_time_s - both.frame_2.device_time_s) * 60
            assert periods == pytest.approx(round(periods), abs=1e-6)
        two.unplug()
        with pytest.raises(FrameTimeoutError, match="camera 2"):
            grab_until_it_fails(pair)
        with pytest.raises(DeviceLostError, match="camera 2"):
            pair.grab(0.05)
        pair.close()
        assert one.controlled is False


@pytest.mark.skipif(
    shutil.which("arv-camera-test-0.8") is None, reason="Aravis' camera test is not installed"
)
def test_aravis_takes_every_frame_from_the_emulated_camera() -> None:
    with GigeCameraEmulator(scene, SENSOR):
        said = subprocess.run(
            ["arv-camera-test-0.8", "-n", "127.0.0.1", "--no-packet-socket", "--duration", "2"],
            capture_output=True,
            text=True,
            timeout=20,
            check=True,
        ).stdout
    counts = dict(line.split("=") for line in said.replace(" ", "").splitlines() if line.startswith("n_"))
    assert int(counts["n_completed_buffers"]) > 60
    assert all(int(counts[n]) == 0 for n in ("n_failures", "n_missing_packets", "n_size_mismatch_errors"))


@given(st.integers(1, 0xFFFF), st.lists(st.integers(-40, 5000), max_size=60))
def test_block_numbers_count_on_where_they_begin_again(first: int, steps: list[int]) -> None:
    numbers, at, furthest = BlockNumbers(), first, first
    assert numbers.number(first) == first
    for step in steps:
        at = furthest + (step or 1)
        if at < 1:
            continue
        # The number of a torn frame may be anything; it moves nothing.
        numbers.number(at * 7919 % 0xFFFF + 1, believed=False)
        assert numbers.number((at - 1) % 0xFFFF + 1) == at
        furthest = max(furthest, at)


ALONE = """
import socket, sys
import numpy as np
import viva_genicam
from adof_drivers.emulators.gige import GigeCameraEmulator
from adof_drivers.gige import GigeCamera
from loopback import control_packets_elsewhere

with GigeCameraEmulator(lambda number, region: np.full(region[1], number, np.uint8), (30, 41)):
    with control_packets_elsewhere() as seen:
        camera = GigeCamera("127.0.0.1")
        camera.start()
        camera.grab()
        camera.close()
    print(len(seen))
    with control_packets_elsewhere() as seen:
        viva_genicam.discover(50)
    print(len(seen) > 0)
"""
NETWORK = (
    "ip link set lo up && ip link add one type veth peer name two "
    "&& ip link set one up && ip link set two up "
    "&& ip address add 10.9.8.7/24 broadcast 10.9.8.255 dev one && ip route add default dev one"
)


@needs_viva
def test_opening_a_camera_on_loopback_asks_nobody_elsewhere_and_the_watch_would_see_it() -> None:
    """In a network of its own, where discovery on every interface may be tried without disturbing anybody."""
    shell = f"{NETWORK} || exit 77; exec {sys.executable} -c '{ALONE}'"
    path = os.pathsep.join([str(Path(__file__).parent), os.environ.get("PYTHONPATH", "")])
    ran = subprocess.run(
        ["unshare", "--map-root-user", "--net", "sh", "-c", shell],
        capture_output=True,
        text=True,
        env=os.environ | {"PYTHONPATH": path},
    )
    if ran.returncode == 77 or "unshare" in ran.stderr:
        pytest.skip("this user may not make a network of its own")
    assert ran.stdout.split() == ["0", "True"], ran.stderr


def test_an_address_already_taken_and_impossible_faults_are_refused() -> None:
    with emulated(), pytest.raises(DriverError, match="another camera emulator"):
        emulated()
    for wrong in ({"packet_loss": 1.5}, {"frame_loss": -0.1}, {"delay_s": -1.0}):
        with pytest.raises(DriverError):
            Faults(**wrong)
    for impossible in (
        {"rate_hz": 0},
        {"pixel_format": "RGB8"},
        {"pixel_format": "Mono12p", "line_padding": 2},
    ):
        with pytest.raises(DriverError):
            GigeCameraEmulator(scene, SENSOR, **impossible)  # type: ignore[arg-type]


@needs_viva
def test_a_source_that_breaks_its_promise_is_told_when_the_camera_closes() -> None:
    emulator = GigeCameraEmulator(lambda _number, _region: np.zeros((2, 2), np.uint8), SENSOR).start()
    camera = GigeCamera("127.0.0.1")
    camera.start()
    with pytest.raises(DriverError):
        camera.grab(0.1)
    camera.close()
    with pytest.raises(DriverError, match="was wanted"):
        emulator.close()


@needs_viva
def test_unknown_and_malformed_commands_leave_the_camera_working(camera: GigeCamera) -> None:
    rng = np.random.default_rng(5)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
        for _ in range(300):
            body = rng.bytes(int(rng.integers(0, 40)))
            command = int(rng.choice([0x02, 0x40, 0x80, 0x82, 0x84, 0x86, 0x1234]))
            header = bytes([0x42, 1, command >> 8, command & 255, 0, len(body), 0, 1])
            stranger.sendto((header + body)[: int(rng.integers(1, 48))], ("127.0.0.1", 3956))
    camera.start()
    assert camera.grab().complete
