"""Recordings: readable by other programs, in Unix time, and without effect on the run when the disk is slow."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader

from drivers.frame import Camera, Frame, gray
from drivers.logs.log_reader import LogReader
from drivers.logs.mcap_writer import RotationSettings
from drivers.motor import VelocityCommand
from omnid.config import Config, RecordConfig
from omnid.core.mapping.voxel_map import MapPoints
from omnid.core.types.panorama import PaddedPanorama, Panoramas
from omnid.engine.robot_clock import RobotClock
from omnid.messages import FramePair, MapUpdate, OdometryUpdate, StereoDepth
from omnid.runs.live import open_recorder
from omnid.sinks.encoder import Encoder
from omnid.sinks.recorder import Recorder
from omnid.transport.codec import ERROR, OK, Diagnostics, DiagnosticStatus
from omnid.transport.status_names import RECORDING, entry
from tests.drivers.logs.mcap_logs import jpeg
from tests.set_clock import SetClock
from tests.simulation import make_rig

START_NS = 1_700_000_000 * 10**9
OFFSET_NS = START_NS - 5 * 10**9  # boot time of the machine: five seconds before
WIDTH, HEIGHT = 6, 4
LENGTHS = {"mono8": 1, "mono16": 2, "bgr8": 3, "rgb8": 3, "bgra8": 4, "rgba8": 4, "yuyv": 2, "uyvy": 2, "nv12": 1}


def frame(seq: int, camera: Camera, encoding: str = "jpeg") -> Frame:
    stamp_ns = 5 * 10**9 + seq * 33_333_333
    if encoding == "jpeg":
        return Frame(seq, stamp_ns, camera, encoding, jpeg(seq))
    step = WIDTH * LENGTHS[encoding] + 4
    rows = HEIGHT * 3 // 2 if encoding == "nv12" else HEIGHT
    data = np.random.default_rng(seq).bytes(step * rows + 100)  # and the unused end of a driver's buffer
    return Frame(seq, stamp_ns, camera, encoding, data, WIDTH, HEIGHT, step)


def small_depth(stamp_ns: int = 0) -> StereoDepth:
    """Return a depth with panoramas of 6 x 4 pixels, all of whose parts are live."""
    panorama = PaddedPanorama(np.zeros((4, 8), np.uint8), 1)
    return StereoDepth(Panoramas(0, stamp_ns, panorama, panorama, np.ones((4, 6), bool)))


def settings(folder: Path, **more: Any) -> Config:
    config, given = Config(), {"folder": str(folder), "free_mb": 0, "file_mb": 1, "images_hz": 0.0} | more
    return replace(config, record=replace(config.record, **given))


def set_clock() -> RobotClock:
    return SetClock(OFFSET_NS).clock()


def of_run(config: Config, clock: RobotClock, rig: str = "") -> Recorder:
    return open_recorder(config, rig, clock, Encoder(make_rig(size=256), 6.0, clock.segment_unix_ns))


def recorded(folder: Path) -> list[Path]:
    return sorted(folder.glob("*.mcap"))


@pytest.mark.parametrize("encoding", ["jpeg", *LENGTHS])
def test_recorded_images_are_read_unchanged_and_found_by_name(tmp_path: Path, encoding: str) -> None:
    recorder = open_recorder(settings(tmp_path / "log"), "", clock=set_clock())
    given = [frame(n, camera, encoding) for n in range(3) for camera in ("lower", "upper")]
    for each in given:
        recorder.process(each)
    recorder.close()
    (path,) = recorded(tmp_path / "log")
    reader = LogReader(path)
    ending = "/compressed" if encoding == "jpeg" else ""
    assert reader.topics == {camera: f"/omnid/{camera}/image_raw{ending}" for camera in ("lower", "upper")}
    for read, each in zip(reader.frames(), given, strict=True):
        assert (read.camera, read.stamp_ns, read.encoding) == (each.camera, each.stamp_ns + OFFSET_NS, encoding)
        assert np.array_equal(gray(read), gray(each))


@pytest.mark.parametrize("skew_ns", [-16_000_000, 100_000, 16_000_000])
def test_a_recording_of_fewer_images_holds_whole_pairs(tmp_path: Path, skew_ns: int) -> None:
    """Of three seconds at 30 Hz 15 pairs at 5 Hz; the images of each are as far apart as the cameras are."""
    config = settings(tmp_path, images_hz=5.0)
    recorder = of_run(config, set_clock())
    for n in range(92):
        lower, upper = frame(n, "lower"), frame(n, "upper")
        upper = replace(upper, stamp_ns=upper.stamp_ns + skew_ns)
        recorder.process(FramePair(n, lower.stamp_ns, gray(lower), gray(upper), frames=(lower, upper)))
    recorder.close()
    found = list(LogReader(recorded(tmp_path)[0]).frames())
    stamps = {camera: [one.stamp_ns for one in found if one.camera == camera] for camera in ("lower", "upper")}
    assert 15 <= len(stamps["lower"]) <= 16
    assert {b - a for a, b in zip(stamps["lower"], stamps["upper"], strict=False)} == {skew_ns}


def odometry(seq: int, state: str = "tracking") -> OdometryUpdate:
    return OdometryUpdate(
        seq, 5 * 10**9 + seq, np.eye(4), np.eye(6), np.zeros(6), np.eye(6), state, 0, 50, 60, small_depth()
    )


def test_all_messages_are_recorded_in_unix_time(tmp_path: Path) -> None:
    recorder = of_run(settings(tmp_path / "log"), set_clock(), "version = 1")
    points = MapPoints(np.zeros((3, 3), np.float32), np.zeros(3, np.float32), *[np.zeros(3, np.int32)] * 2)
    for n in range(4):
        recorder.process(odometry(n, "lost" if n == 3 else "tracking"))
        recorder.process(VelocityCommand(5 * 10**9 + n, 0.1, math.nan, 0.2))
    recorder.process(Diagnostics(5 * 10**9, (DiagnosticStatus("omnid: test", 0, "fine", {}),)))
    recorder.process(MapUpdate(0, 5 * 10**9, points, np.zeros((0, 2))))
    recorder.close()
    (path,) = recorded(tmp_path / "log")
    counts: dict[str, int] = {}
    with AnyReader([path]) as bag:
        (frames,) = [found for found in bag.connections if found.topic == "/tf_static"]
        # A player publishes them for late subscribers, as the quality says that is stored with the topic.
        (stored,) = cast("Any", frames.ext).offered_qos_profiles
        assert (stored.history.name, stored.depth, stored.reliability.name) == ("KEEP_LAST", 1, "RELIABLE")
        assert stored.durability.name == "TRANSIENT_LOCAL"
        for connection, stamp_ns, data in bag.messages():
            counts[connection.topic] = counts.get(connection.topic, 0) + 1
            message: Any = bag.deserialize(data, connection.msgtype)
            header = message.transforms[0].header if connection.topic.startswith("/tf") else message.header
            written_ns = header.stamp.sec * 10**9 + header.stamp.nanosec
            assert START_NS <= written_ns <= START_NS + 3 and stamp_ns == written_ns
    assert counts == {
        "/omnid/odom": 4,
        "/omnid/pose": 4,
        "/tf": 4,
        "/omnid/drive": 4,
        "/omnid/status": 3,
        "/omnid/cloud": 1,
        "/tf_static": 1,
    }
    assert set(attached(path)) == {"omnid.toml", "rig.toml"}


@pytest.mark.parametrize("step_s", [-7200.0, -3.0, 0.02, 3600.0, 1.5e8])
def test_a_step_of_the_clock_begins_a_file_and_no_file_has_one_in_it(
    tmp_path: Path, step_s: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The oldest files are deleted by their order in the run, whatever their names say."""
    computer = SetClock(OFFSET_NS)
    computer.advance(5.0)
    monkeypatch.setattr(
        RecordConfig, "rotation", lambda _: RotationSettings(file_bytes=10**6, keep_bytes=10**6 + 65_000, free_bytes=0)
    )
    config = settings(tmp_path / "log")
    recorder = of_run(config, computer.clock())
    for n in range(30):
        stamp_ns = 5 * 10**9 + n * 10**8
        for camera in ("lower", "upper"):
            recorder.process(replace(frame(n, camera), stamp_ns=stamp_ns))
        computer.advance(0.1)
        recorder.process(Diagnostics(stamp_ns, (DiagnosticStatus("omnid: test", 0, "fine", {}),)))
        if n in (9, 19):
            computer.set_forwards(step_s)
        recorder.process(
            replace(odometry(n), stamp_ns=stamp_ns)
        )  # Its images are from before the step, and it comes after it.
    recorder.close()
    written = []
    for path in recorded(tmp_path / "log"):
        with path.open("rb") as file:
            logged = [(message.log_time, channel.topic) for _, channel, message in make_reader(file).iter_messages()]
        with AnyReader([path]) as bag:
            stamps = [
                message.header.stamp.sec * 10**9 + message.header.stamp.nanosec
                for connection, _, data in bag.messages()
                if not connection.topic.startswith("/tf")
                for message in [cast("Any", bag.deserialize(data, connection.msgtype))]
            ]
        assert sorted(stamps) == sorted(at_ns for at_ns, topic in logged if not topic.startswith("/tf"))
        assert max(stamps) - min(stamps) < 1.1e9, "no step within a file"
        images = [at_ns for at_ns, topic in logged if topic == "/omnid/lower/image_raw/compressed"]
        written.append((images[0] - OFFSET_NS, len(images)))
    steps_ns = round(step_s * 1e9)
    assert sorted(written) == sorted([(6 * 10**9 + steps_ns, 10), (7 * 10**9 + 2 * steps_ns, 10)])


def attached(path: Path) -> list[str]:
    with path.open("rb") as file:
        return [attachment.name for attachment in make_reader(file).iter_attachments()]


def test_every_file_has_the_state_of_the_odometry(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(RecordConfig, "rotation", lambda _: RotationSettings(10**9, 10**10, 0, file_s=1.0))
    config = settings(tmp_path / "log")
    recorder = of_run(config, set_clock())
    for n in range(30):
        recorder.process(replace(odometry(n), stamp_ns=5 * 10**9 + n * 10**8))
    recorder.close()
    files = recorded(tmp_path / "log")
    assert len(files) == 3
    for path in files:
        with path.open("rb") as file:
            assert sum(1 for _ in make_reader(file).iter_messages(["/omnid/status"])) == 1


def test_the_recorder_reports_its_state(tmp_path: Path) -> None:
    config = settings(tmp_path / "log")
    recorder = open_recorder(config, "", clock=set_clock())
    assert (entry(RECORDING, recorder.stats()).level, entry(RECORDING, recorder.stats()).message) == (OK, "recording")
    recorder.process(frame(0, "lower"))
    status = entry(RECORDING, recorder.stats())
    assert status.message == "recording" and status.values["messages"] == status.values["files"] == "1"
    recorder.close()
    full = replace(config, record=replace(config.record, free_mb=1_000_000))
    recorder = open_recorder(full, "", clock=set_clock())
    recorder.process(frame(0, "lower"))
    status = entry(RECORDING, recorder.stats())
    assert status.level == ERROR and status.values["lost"] == "1" and "1000001 needed" in status.message
