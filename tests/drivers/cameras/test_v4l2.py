"""V4L2 devices: the kernel structures, found cameras, the choice of a format, controls, and errors with advice."""

from __future__ import annotations

import ctypes
import errno
import logging
import runpy
import threading
import time
from contextlib import closing
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest

from drivers.cameras import v4l2_ioctl
from drivers.cameras import v4l2_ioctl as v4l2
from drivers.cameras.camera_state import CameraExposure, CameraState, ExposureRequest, ExposureSetting
from drivers.cameras.v4l2_camera import BufferChecks, V4l2Camera
from drivers.cameras.v4l2_device import (
    V4l2Settings,
    V4l2Stream,
    capture_devices,
    exposure_ranges,
    follow_request,
    set_controls,
)
from drivers.cameras.v4l2_ioctl import BufferFlag
from drivers.errors import DriverError
from drivers.frame import Frame
from omnid.cli import main
from omnid.commands import machine
from tests.drivers.cameras.fake_camera import (
    APERTURE_PRIORITY,
    AUTO_EXPOSURE,
    AUTO_GAIN,
    CONTRAST,
    EXPOSURE,
    EXPOSURE_MAY_SLOW,
    GAIN,
    FakeCamera,
)
from tests.waiting import wait_until

SIZES = {  # struct v4l2_...: (64 bits, 32 bits)
    "DeviceCapability": (104, 104), "PixelFormat": (48, 48), "Format": (208, 204), "StreamParameters": (204, 204),
    "BufferRequest": (20, 20), "V4l2Buffer": (88, 68), "QueryControl": (68, 68), "V4l2Control": (8, 8),
}  # fmt: skip
OFFSETS = {
    ("V4l2Buffer", "flags"): (12, 12), ("V4l2Buffer", "timestamp"): (24, 20), ("V4l2Buffer", "sequence"): (56, 44),
    ("V4l2Buffer", "m"): (64, 52), ("V4l2Buffer", "length"): (72, 56), ("Format", "fmt"): (8, 4),
    ("StreamParameters", "capability"): (4, 4), ("StreamParameters", "timeperframe"): (12, 12),
}  # fmt: skip
REQUESTS = {  # code by its argument and name
    ("DeviceCapability", "QUERYCAP"): (0x80685600, 0x80685600), ("Format", "S_FMT"): (0xC0D05605, 0xC0CC5605),
    ("BufferRequest", "REQBUFS"): (0xC0145608, 0xC0145608), ("V4l2Buffer", "QUERYBUF"): (0xC0585609, 0xC0445609),
    ("V4l2Buffer", "QBUF"): (0xC058560F, 0xC044560F), ("V4l2Buffer", "DQBUF"): (0xC0585611, 0xC0445611),
    ("Int32", "STREAMON"): (0x40045612, 0x40045612), ("StreamParameters", "G_PARM"): (0xC0CC5615, 0xC0CC5615),
    ("StreamParameters", "S_PARM"): (0xC0CC5616, 0xC0CC5616), ("V4l2Control", "G_CTRL"): (0xC008561B, 0xC008561B),
    ("V4l2Control", "S_CTRL"): (0xC008561C, 0xC008561C), ("QueryControl", "QUERYCTRL"): (0xC0445624, 0xC0445624),
}  # fmt: skip


@pytest.fixture(params=[0, 1], ids=["64 bits", "32 bits"])
def abi(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> tuple[dict[str, Any], int]:
    """The module's names where a long has 64 or 32 bits, and the index of that case."""
    monkeypatch.setattr(ctypes, "c_long", (ctypes.c_int64, ctypes.c_int32)[request.param])
    return runpy.run_path(v4l2_ioctl.__file__), request.param


def test_structures_and_requests_are_the_kernels(abi: tuple[dict[str, Any], int]) -> None:
    names, bits = abi
    assert {name: ctypes.sizeof(names[name]) for name in SIZES} == {name: sizes[bits] for name, sizes in SIZES.items()}
    found = {(struct, member): getattr(names[struct], member).offset for struct, member in OFFSETS}
    assert found == {member: offsets[bits] for member, offsets in OFFSETS.items()}
    codes = {(kind, name): names["request_code"](name, names[kind]()) for kind, name in REQUESTS}
    assert codes == {request: numbers[bits] for request, numbers in REQUESTS.items()}


PORT = "pci-0000:00:14.0-usb-0:1:1.0"


def plug(root: Path, number: int, port: str, index: int = 0) -> None:
    """Create the entries of a node of a camera as the kernel and udev do; its device is an ordinary file."""
    entry = root / f"sys/class/video4linux/video{number}"
    entry.mkdir(parents=True)
    (entry / "name").write_text("HD Webcam\n")
    (entry / "index").write_text(f"{index}\n")
    (root / "dev/v4l/by-path").mkdir(parents=True, exist_ok=True)
    (root / f"dev/video{number}").touch()
    for name in (port, port.replace("-usb-", "-usbv2-")):  # a newer udev makes two links for a port
        (root / f"dev/v4l/by-path/{name}-video-index{index}").symlink_to(f"../../video{number}")


@pytest.fixture
def two_webcams(tmp_path: Path) -> Path:
    """Two cameras of one model, each with a metadata node."""
    for number, port in ((2, PORT), (10, PORT.replace("0:1:", "0:2:"))):
        plug(tmp_path, number, port)
        plug(tmp_path, number + 1, port, index=1)
    return tmp_path


def test_cameras_are_listed_by_number_without_metadata_nodes(two_webcams: Path) -> None:
    found = capture_devices(two_webcams)
    assert [(device.node, device.name) for device in found] == [
        ("/dev/video2", "HD Webcam"), ("/dev/video10", "HD Webcam"),
    ]  # fmt: skip
    assert found[0].by_path == f"/dev/v4l/by-path/{PORT}-video-index0"
    (two_webcams / "dev/video10").unlink()
    first, second = capture_devices(two_webcams)
    assert "is not a video device" in first.problem and "is not there" in second.problem


def test_the_command_lists_the_cameras(
    two_webcams: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(machine, "ROOT", two_webcams)
    monkeypatch.setattr(v4l2, "call", FakeCamera().call)
    assert main(["cameras"]) == 0
    printed = capsys.readouterr().out
    assert "/dev/video2  HD Webcam\n" in printed
    assert "v4l2-ctl -d /dev/video2 --list-formats-ext" in printed
    assert f"/dev/v4l/by-path/{PORT}-video-index0" in printed and "90-omnid.rules" in printed
    monkeypatch.setattr(machine, "ROOT", two_webcams / "none")
    assert main(["cameras"]) == 1
    missing = capsys.readouterr()
    assert missing.out == "" and missing.err.startswith("omnid: no cameras") and missing.err.count("\n") == 1


def image(path: Path, **fields: Any) -> str:
    """Return the image that a camera gives with these settings."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(v4l2, "call", FakeCamera(path).call)
        with closing(V4l2Stream(V4l2Settings(str(path), **fields))) as stream:
            return str(stream.image)


@pytest.mark.parametrize(
    ("fields", "expected"),
    [
        ({"width_px": 640, "height_px": 480}, "YUYV 640x480 at 30 Hz"),
        ({"rate_hz": 5.0}, "YUYV 1280x960 at 5 Hz"),
        ({"pixel_format": "MJPG"}, "MJPG 1280x960 at 30 Hz"),
    ],
)
def test_auto_prefers_a_format_without_decoding_if_it_is_fast_enough(
    tmp_path: Path, fields: dict[str, Any], expected: str
) -> None:
    assert image(tmp_path / "video", **fields) == expected


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"pixel_format": "GREY", "width_px": 640, "height_px": 480}, "GREY 640x480 at 30 Hz is not offered; .* YUYV"),
        ({"pixel_format": "YUYV", "height_px": 481}, "the device sets YUYV 640x480 at 30 Hz instead"),
        ({"rate_hz": 60.0}, r"auto 1280x960 at 60 Hz is not offered; .*MJPG 1280x960 at 30 Hz"),
    ],
)
def test_another_mode_is_refused_and_that_of_the_device_is_named(
    tmp_path: Path, fields: dict[str, Any], message: str
) -> None:
    with pytest.raises(DriverError, match=message) as caught:
        image(tmp_path / "video", **fields)
    assert "--list-formats-ext" in str(caught.value) and "\n" not in str(caught.value)


FD = 1000


@pytest.fixture
def camera(monkeypatch: pytest.MonkeyPatch) -> FakeCamera:
    made = FakeCamera()
    monkeypatch.setattr(v4l2, "call", made.call)
    return made


def written(camera: FakeCamera, **fields: Any) -> list[tuple[int, int]]:
    """Return the controls that settings set, in order."""
    set_controls(FD, V4l2Settings("/dev/omnid/lower", **fields))
    return camera.written


@pytest.mark.parametrize(
    ("fields", "expected"),
    [
        ({}, []),
        (
            {"exposure_us": 10_040, "gain": 15},
            [(AUTO_EXPOSURE, 1), (EXPOSURE_MAY_SLOW, 0), (EXPOSURE, 100), (AUTO_GAIN, 0), (GAIN, 15)],
        ),
        ({"auto_exposure": "rig", "exposure_us": 5000}, [(AUTO_EXPOSURE, 1), (EXPOSURE_MAY_SLOW, 0), (EXPOSURE, 50)]),
        ({"auto_exposure": "on"}, [(AUTO_EXPOSURE, APERTURE_PRIORITY), (EXPOSURE_MAY_SLOW, 0)]),
        ({"auto_exposure": "rig"}, [(AUTO_EXPOSURE, APERTURE_PRIORITY), (EXPOSURE_MAY_SLOW, 0), (AUTO_GAIN, 1)]),
        ({"controls": ("contrast = -3",)}, [(CONTRAST, -3)]),
    ],
)
def test_automatic_modes_come_before_the_values_that_they_govern(
    camera: FakeCamera, fields: dict[str, Any], expected: list[tuple[int, int]]
) -> None:
    assert written(camera, **fields) == expected


def test_controls_that_a_camera_lacks_are_needed_only_where_they_are_set(camera: FakeCamera) -> None:
    camera.menu = (0, 1, 3)
    assert written(camera, auto_exposure="on")[0] == (AUTO_EXPOSURE, 0)
    del camera.controls[AUTO_GAIN], camera.controls[AUTO_EXPOSURE], camera.controls[EXPOSURE_MAY_SLOW]
    camera.written.clear()
    assert written(camera, auto_exposure="rig") == []
    for fields, name in (
        ({"power_line": "50"}, "power_line"),
        ({"exposure_us": 100}, "auto_exposure"),
        ({"controls": ("sharpness=1",)}, "controls: sharpness"),
    ):
        with pytest.raises(DriverError, match=f"no control for cameras.{name}. It has: contrast, gain"):
            written(camera, **fields)


def test_a_value_that_the_device_does_not_take_is_an_error(camera: FakeCamera, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(camera, "_set_control", lambda control: None)
    with pytest.raises(DriverError, match="contrast: 3 was set, the device stays at 1"):
        written(camera, controls=("contrast=3",))
    camera.failing = errno.EIO
    with pytest.raises(DriverError, match=r"contrast: the device refused 3 \(Input/output error\)"):
        written(camera, controls=("contrast=3",))
    camera.failing = errno.ENODEV
    with pytest.raises(OSError, match="No such device"):
        written(camera, controls=("contrast=3",))
    for text in ("gain", "gain=high", "=3"):
        with pytest.raises(DriverError, match="give entries such as"):
            written(camera, controls=(text,))


REGULATED = V4l2Settings("/dev/omnid/lower", auto_exposure="rig")


@pytest.fixture
def exposure(camera: FakeCamera) -> CameraExposure:
    ranges = exposure_ranges(FD, REGULATED)
    assert ranges is not None
    return CameraExposure(ranges)


def test_a_request_is_carried_out_once_when_due_and_given_back(camera: FakeCamera, exposure: CameraExposure) -> None:
    follow_request(FD, REGULATED, exposure, 500)
    exposure.request = ExposureRequest(ExposureSetting(8000, 10), after_ns=1000)
    follow_request(FD, REGULATED, exposure, 999)
    assert camera.written == []
    for stamp_ns in (1000, 2000):
        follow_request(FD, REGULATED, exposure, stamp_ns)
        assert camera.written == [(AUTO_EXPOSURE, 1), (AUTO_GAIN, 0), (EXPOSURE, 80), (GAIN, 10)]
        assert exposure.in_force == ExposureSetting(8000, 10)
    exposure.request = ExposureRequest(None, after_ns=0)
    follow_request(FD, REGULATED, exposure, 3000)
    assert camera.values[AUTO_EXPOSURE] == APERTURE_PRIORITY and camera.values[AUTO_GAIN] == 1


def test_a_refusal_is_kept_and_ends_the_requests_a_lost_device_raises(
    camera: FakeCamera, exposure: CameraExposure
) -> None:
    exposure.request, camera.failing = ExposureRequest(ExposureSetting(8000, 1), after_ns=0), errno.ERANGE
    follow_request(FD, REGULATED, exposure, 1)
    assert "refused an exposure" in exposure.problem and "result out of range" in exposure.problem
    camera.failing = 0
    exposure.request = ExposureRequest(ExposureSetting(8000, 2), after_ns=0)
    follow_request(FD, REGULATED, exposure, 2)
    assert camera.values[GAIN] == 65
    lost = CameraExposure(exposure.ranges, exposure.request)
    camera.failing = errno.ENODEV
    with pytest.raises(OSError, match="No such device"):
        follow_request(FD, REGULATED, lost, 1)


# A V4L2 camera as a source of frames: stamps, losses, and a device that is gone for a while


PERIOD_NS = 33_333_000
START_NS = 5_000 * 10**9
DELAY_NS = 2_000_000
MIN_BYTES = 100


def test_frames_go_on_after_a_loss_with_all_settings(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fake, events, taken = FakeCamera(tmp_path / "video0"), list[str](), list[Frame]()
    monkeypatch.setattr(v4l2, "call", fake.call)
    settings = V4l2Settings(str(tmp_path / "video0"), timeout_s=0.2, controls=("contrast=7",))
    camera = V4l2Camera(settings, "lower", on_event=lambda _, text: events.append(text))
    reader = threading.Thread(target=lambda: taken.extend(camera.frames()), daemon=True)

    def more(*sequences: int) -> None:
        """Let images come, while the camera streams."""
        wanted = camera.state.frames + len(sequences) - (camera.state.status == "lost")
        for sequence in sequences:
            fake.fill(sequence, time.monotonic_ns())
            time.sleep(0.002)
        wait_until(lambda: camera.state.frames >= wanted)

    reader.start()
    wait_until(lambda: camera._reading)
    time.sleep(0.05)  # images from before are discarded
    more(0, 1, 4)
    assert camera.state.drops == 2 and camera.state.mode == "MJPG 1280x960 at 30 Hz"
    # 1. The device is gone, and comes back with other values.
    fake.failing = errno.ENODEV
    wait_until(lambda: camera.state.status == "lost")
    fake.values[0x00980901], fake.failing = 0, 0
    wait_until(lambda: camera.state.reopens >= 1)
    more(0, 1, 2)
    assert fake.values[0x00980901] == 7 and camera.state.status == "streaming"
    # 2. It sends nothing.
    wait_until(lambda: "no valid image for 0.2 s" in camera.state.problem)
    reopens = camera.state.reopens
    wait_until(lambda: camera.state.reopens > reopens)
    more(0, 1, 2)
    camera.close()
    reader.join()
    assert [frame.seq for frame in taken] == list(range(len(taken))) and camera.state.status == "closed"
    assert all(before.stamp_ns < after.stamp_ns for before, after in pairwise(taken))
    assert [text.partition(":")[2].split(",")[0] for text in events] == [" lost", " back"] * 2


class Buffers:
    """The checks of buffers with their state and events."""

    def __init__(self) -> None:
        self.state, self.events = CameraState(), list[tuple[int, str]]()
        self.checks = BufferChecks("lower camera", self.state, 2.0, lambda *event: self.events.append(event))

    def accepted(self, *buffers: dict[str, int]) -> list[bool]:
        usual = {"flags": BufferFlag.TIMESTAMP_MONOTONIC, "bytesused": MIN_BYTES}
        return [self.checks.accept(v4l2.V4l2Buffer(**(usual | buffer)), MIN_BYTES) for buffer in buffers]

    def stamp(self, stamp_ns: int, arrival_ns: int, flags: int = BufferFlag.TIMESTAMP_MONOTONIC) -> int:
        buffer = v4l2.V4l2Buffer(flags=flags)
        buffer.timestamp.tv_sec, rest_ns = divmod(stamp_ns, 10**9)
        buffer.timestamp.tv_usec = rest_ns // 1000
        return self.checks.stamp_ns(buffer, arrival_ns)


@pytest.fixture
def buffers() -> Buffers:
    return Buffers()


@pytest.mark.parametrize(
    ("sequences", "drops", "restarts"),
    [
        ((7, 8, 10, 14), 4, 0),
        ((2**32 - 2, 1), 2, 0),  # across the overflow
        *(((100, again), 0, 1) for again in (0, 99, 100)),
    ],
)
def test_gaps_of_the_sequence_are_drops_and_a_restart_drops_nothing(
    buffers: Buffers, sequences: tuple[int, ...], drops: int, restarts: int
) -> None:
    buffers.accepted(*({"sequence": sequence} for sequence in sequences))
    assert (buffers.state.drops, buffers.state.restarts) == (drops, restarts)


@pytest.mark.parametrize("broken", [{"flags": BufferFlag.ERROR}, {"bytesused": 99}])
def test_broken_buffers_are_errors_and_not_drops(buffers: Buffers, broken: dict[str, int]) -> None:
    assert buffers.accepted({}, broken | {"sequence": 1}, {"sequence": 2}) == [True, False, True]
    assert (buffers.state.errors, buffers.state.drops) == (1, 0)


@pytest.mark.parametrize("flags", [0, 0x4000])
def test_a_camera_with_an_undeclared_clock_is_accepted_with_one_warning(buffers: Buffers, flags: int) -> None:
    expected = [START_NS, START_NS + PERIOD_NS]
    assert [buffers.stamp(stamp_ns, stamp_ns + DELAY_NS, flags) for stamp_ns in expected] == expected
    assert [level for level, _ in buffers.events] == [logging.WARNING]
    assert buffers.events[0][1].startswith("lower camera: ") and "clock" in buffers.events[0][1]


@pytest.mark.parametrize("stamp_ns", [0, START_NS - 11 * 10**9, 1_700_000_000 * 10**9])
def test_stamps_of_another_clock_are_replaced_by_the_arrival(buffers: Buffers, stamp_ns: int) -> None:
    assert buffers.stamp(stamp_ns, START_NS) == START_NS
    assert buffers.state.restamped == 1


def test_stamps_increase_strictly(buffers: Buffers) -> None:
    first = buffers.stamp(START_NS, START_NS + 10)
    earlier = buffers.stamp(START_NS - 1000, START_NS + PERIOD_NS)
    at_the_same_time = buffers.stamp(START_NS, START_NS + PERIOD_NS)
    replaced_ns = START_NS + PERIOD_NS - 10  # the arrival less the delay of the first
    assert (first, earlier, at_the_same_time) == (START_NS, replaced_ns, replaced_ns + 1)
    assert buffers.state.restamped == 2


def test_images_of_a_clock_that_fell_back_are_dated_by_their_arrival_permanently(buffers: Buffers) -> None:
    found = []
    for number in range(300):
        taken_ns = START_NS + PERIOD_NS * number
        kernel_ns = taken_ns - 3 * 10**9 * (number >= 30)
        found.append(buffers.stamp(kernel_ns, taken_ns + DELAY_NS) - taken_ns)
    assert found == [0] * 300 and buffers.state.restamped == 270
