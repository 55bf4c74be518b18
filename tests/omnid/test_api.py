"""The public Python API and the client: lazy imports, replay, odometry of images, and all example programs."""

from __future__ import annotations

import contextlib
import math
import os
import re
import runpy
import struct
import subprocess
import sys
import textwrap
import time
import tty
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from itertools import count
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

import omnid
import omnid.client
from calib import se3
from calib.rig_file import read_rig, write_rig
from drivers.frame import gray
from drivers.logs.log_reader import LogReader
from drivers.motion import GyroSample
from omnid.client import Answer, Driver, Robot
from omnid.errors import OmnidError
from omnid.formats.tum import Trajectory, tum_row
from omnid.transport import codec
from omnid.transport.bus import Bus, BusConfig
from omnid.transport.codec import IMU_SCHEMA, PoseAttachment
from omnid.transport.commands import Freshness
from omnid.transport.sensor_codec import sample_from_cdr
from omnid.transport.topics import Request
from tests.conftest import PAIRS
from tests.omnid.transport.bus_fixtures import free_endpoint, odometry, script, session
from tests.ply import read_ply
from tests.replay import edited
from tests.replay.command import Command
from tests.simulation.paths import planar_poses
from tests.waiting import wait_until

pytestmark = pytest.mark.usefixtures("default_signals")

ROOT = Path(__file__).parents[2]
Pair = tuple[int, np.ndarray, np.ndarray]
FEW = 8  # pairs


@pytest.fixture(scope="module")
def pairs(scene: Path) -> list[Pair]:
    """The pairs of the scene: stamp of the lower image, lower and upper image."""
    frames = list(LogReader(scene / "log.mcap").frames())
    lower, upper = ([frame for frame in frames if frame.camera == name] for name in ("lower", "upper"))
    return [(below.stamp_ns, gray(below), gray(above)) for below, above in zip(lower, upper, strict=True)]


@pytest.fixture(scope="module")
def start(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A log of the first pairs of the scene."""
    path = tmp_path_factory.mktemp("start") / "log.mcap"
    return edited.save(path, (image for image in edited.images(scene / "log.mcap") if image.pair < FEW))


@pytest.fixture(scope="module")
def result(scene: Path) -> omnid.RunResult:
    """The result of a replay of the scene."""
    return omnid.replay(scene / "log.mcap", rig=scene / "rig.toml")


@pytest.fixture
def omnid_command(capsys: pytest.CaptureFixture[str]) -> Command:
    return Command(capsys)


def test_import_loads_neither_numpy_nor_opencv() -> None:
    program = "import omnid, sys; print(sorted({'numpy', 'cv2', 'zenoh', 'omnid.config'} & set(sys.modules)))"
    out = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, cwd=ROOT, check=True).stdout
    assert out == "[]\n"


def test_replay_gives_what_the_command_writes(
    omnid_command: Command, tmp_path: Path, scene: Path, result: omnid.RunResult
) -> None:
    files = ("--tum", tmp_path / "a.tum", "--cloud", tmp_path / "a.ply")
    assert omnid_command.replay(scene / "log.mcap", *files, rig=scene / "rig.toml").code == 0
    result.save_tum(tmp_path / "b.tum")
    result.save_ply(str(tmp_path / "b.ply"))
    for suffix in ("tum", "ply"):
        assert (tmp_path / f"a.{suffix}").read_bytes() == (tmp_path / f"b.{suffix}").read_bytes()
    assert len(read_ply(tmp_path / "b.ply").xyz) > 500


def test_the_result_holds_arrays_counters_and_timings(result: omnid.RunResult) -> None:
    assert result.stamps_ns.shape == (PAIRS,) and result.stamps_ns.dtype == np.int64
    assert result.T_odom_rig.shape == (PAIRS, 4, 4) and result.covariances.shape == (PAIRS, 6, 6)
    assert set(result.states) == {omnid.TrackingState.TRACKING} and len(result.states) == PAIRS
    counters = result.counters
    assert (counters.pairs, counters.poses, counters.resets) == (PAIRS, PAIRS, 0)
    assert counters.states[omnid.TrackingState.TRACKING] == PAIRS and not any(counters.drops.values())
    steps = np.diff(result.T_odom_rig[:, :3, 3], axis=0)
    assert counters.length_m == pytest.approx(np.linalg.norm(steps, axis=1).sum())
    assert result.signal == 0
    assert len(result.warnings) == 1 and "height of the cameras" in result.warnings[0]  # the rig does not state it
    for stage in ("pair", "dewarp", "odometry", "mapping"):
        timing = result.timings[stage]
        assert timing["n"] >= PAIRS and 0 < timing["p50_ms"] <= timing["p99_ms"] <= timing["max_ms"]


def test_a_result_is_compared_with_the_truth(result: omnid.RunResult, tmp_path: Path) -> None:
    result.save_tum(tmp_path / "truth.tum")
    metrics = result.evaluate(tmp_path / "truth.tum")
    assert metrics.pairs == PAIRS and metrics.ate_max_m < 1e-6 and "position error (ATE)" in str(metrics)
    longer = Trajectory(result.stamps_ns, result.T_odom_rig.copy())
    longer.T[:, :3, 3] *= 1.25
    assert result.evaluate(longer).length_error_ratio == pytest.approx(1 / 1.25 - 1)


def test_replay_takes_settings_a_rig_and_a_method(scene: Path, start: Path, result: omnid.RunResult) -> None:
    rig = read_rig(scene / "rig.toml")
    config = replace(omnid.Config(), mapping=replace(omnid.Config().mapping, voxel_m=0.2))
    coarse = omnid.replay(scene / "log.mcap", rig, config=config)
    assert result.map is not None and coarse.map is not None and len(coarse.map.xyz) < len(result.map.xyz) / 2
    assert np.array_equal(coarse.T_odom_rig, result.T_odom_rig)
    paper = omnid.replay(start, rig, config=config, method="paper", overrides="mapping.rate_hz=8")
    assert len(paper.stamps_ns) == FEW and not np.array_equal(paper.T_odom_rig, result.T_odom_rig[:FEW])


def test_images_give_the_bytes_of_a_replay(scene: Path, pairs: list[Pair], result: omnid.RunResult) -> None:
    odometry = omnid.Odometry(scene / "rig.toml")
    poses = [odometry.process(*pair) for pair in pairs]
    assert np.array_equal([pose.T_odom_rig for pose in poses], result.T_odom_rig)
    assert np.array_equal([pose.covariance for pose in poses], result.covariances)
    rows = [tum_row(pose.stamp_ns, pose.T_odom_rig) for pose in poses]
    assert rows == [tum_row(int(s), T) for s, T in zip(result.stamps_ns, result.T_odom_rig, strict=True)]
    depth, seen = odometry.depth(poses[-1]), poses[-1].depth.panoramas
    assert depth.disparity.shape == seen.lower.panorama.shape == seen.upper.panorama.shape
    assert depth.points.shape == (len(depth.variance_m2), 3) and len(depth.points) > 500


def test_wrong_images_and_stamps_are_refused_and_change_nothing(scene: Path, pairs: list[Pair]) -> None:
    odometry, whole = omnid.Odometry(scene / "rig.toml"), omnid.Odometry(scene / "rig.toml")
    first_ns, lower, upper = pairs[0]
    wrong = {
        "found NoneType": (first_ns, None, upper),
        "found list": (first_ns, lower, upper.tolist()),
        r"found \(256, 256, 3\) uint8": (first_ns, cv2.cvtColor(lower, cv2.COLOR_GRAY2BGR), upper),
        r"lower image.*found \(255, 256\)": (first_ns, lower[1:], upper),
        r"upper image.*found \(256, 256\) float64": (first_ns, lower, upper.astype(float)),
        "expected an integer": (first_ns * 1e-9, lower, upper),
    }
    for message, arguments in wrong.items():
        with pytest.raises(OmnidError, match=message):
            odometry.process(*arguments)  # type: ignore[arg-type]
    np.testing.assert_allclose(odometry.process(*pairs[0]).T_odom_rig, np.eye(4), atol=1e-12)
    for stamp_ns in (first_ns, first_ns - 1):
        with pytest.raises(OmnidError, match="expected a stamp after"):
            odometry.process(stamp_ns, lower, upper)
    whole.process(*pairs[0])
    assert np.array_equal(odometry.process(*pairs[1]).T_odom_rig, whole.process(*pairs[1]).T_odom_rig)


def test_an_image_that_repeats_an_earlier_one_is_refused_and_changes_nothing(scene: Path, pairs: list[Pair]) -> None:
    """A replay drops it: of a frozen camera the pose would not move, with a sigma of a millimetre."""
    odometry, whole, used = (
        omnid.Odometry(scene / "rig.toml", overrides=[f'pair.repeated_images="{policy}"'])
        for policy in ("drop", "drop", "use")
    )
    buffers = [np.empty_like(image) for image in pairs[0][1:]]  # a program may read all images into the same arrays
    for number, (stamp_ns, *images) in enumerate(pairs[:4]):
        for buffer, image in zip(buffers, images, strict=True):
            buffer[:] = image
        pose, expected = odometry.process(stamp_ns, *buffers), whole.process(stamp_ns, *images)
        assert np.array_equal(pose.T_odom_rig, expected.T_odom_rig)
        used.process(stamp_ns, *images)
        for lower, upper in (images, (images[0], images[1] ^ np.uint8(number + 1))):
            with pytest.raises(OmnidError, match="is the one before of its camera"):
                odometry.process(stamp_ns + 1, lower, upper)
        used.process(stamp_ns + 1, *images)
    for later_ns in (1, 2):
        for buffer in buffers:
            buffer[1, later_ns] ^= 1
        odometry.process(stamp_ns + later_ns, *buffers)


def test_the_code_of_the_page_on_replays_runs(
    tmp_path: Path, scene: Path, start: Path, pairs: list[Pair], monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, file in (("log.mcap", start), ("rig.toml", scene / "rig.toml"), ("truth.tum", tmp_path / "est.txt")):
        (tmp_path / name).symlink_to(file)
    monkeypatch.chdir(tmp_path)
    names: dict[str, Any] = {"pairs": pairs[:2]}
    for code in re.findall("```python\n(.*?)```", (ROOT / "docs/replay.md").read_text("utf-8"), re.DOTALL):
        exec(code, names)
    assert len(names["points"]) > 100


def test_the_example_of_the_geometry_runs(tmp_path: Path, scene: Path, pairs: list[Pair]) -> None:
    write_rig(tmp_path / "rig.toml", read_rig(scene / "rig.toml"))
    cv2.imwrite(str(tmp_path / "lower.png"), pairs[0][1])
    program = [sys.executable, "-m", "omnid.examples.rectify_image"]
    run = partial(
        subprocess.run, capture_output=True, text=True, cwd=tmp_path, env=os.environ | {"PYTHONPATH": str(ROOT)}
    )
    out = run([*program, "rig.toml", "lower.png", "panorama.png"]).stdout
    panorama = cv2.imread(str(tmp_path / "panorama.png"), cv2.IMREAD_GRAYSCALE)
    assert "is at pixel" in out and panorama is not None and panorama.shape[1] > 4 * panorama.shape[0] / 2
    help_text = run(program).stderr
    assert "`python -m omnid.examples.rectify_image " in help_text and "Traceback" not in help_text


@contextlib.contextmanager
def robot() -> Iterator[tuple[Bus, str]]:
    endpoint = free_endpoint()
    with contextlib.closing(Bus(BusConfig(listen=(endpoint,)))) as bus:
        yield bus, endpoint


def test_the_client_imports_nothing_that_only_the_daemon_needs() -> None:
    words = [sys.executable, "-c", "import omnid.client, sys; print(*sys.modules)"]
    modules = subprocess.run(words, capture_output=True, text=True, check=True).stdout.split()
    assert not {"cv2", "serial", "filterpy", "mcap", "scipy"} & set(modules) and "zenoh" in modules


def docstring_code(text: str | None) -> str:
    """Return the code in a docstring: its indented part."""
    lines = textwrap.dedent((text or "").split("\n", 1)[1]).splitlines()
    return textwrap.dedent("\n".join(line for line in lines if line.startswith("    "))) + "\n"


def test_the_subscriber_example_prints_poses() -> None:
    with robot() as (bus, endpoint):
        code = docstring_code(omnid.client.__doc__).replace('("omnid")', f'("omnid", connect=("{endpoint}",))')
        assert 5 <= len(code.strip().splitlines()) <= 10
        with script(f"print('ready', flush=True)\n{code}") as process:
            numbers = count()
            attachment = PoseAttachment(1, "tracking").to_bytes()
            wait_until(
                lambda: bus.publish("odom", odometry(next(numbers)), attachment) is None and process.poll() is not None
            )
            assert process.returncode == 0 and process.stdout is not None
            assert process.stdout.read().startswith("tracking: ")


def test_the_waypoint_example_drives_a_robot_to_the_last_waypoint() -> None:
    """The robot is simulated: its odometry follows the commands."""
    state = {"x": 0.0, "y": 0.0}
    stops: list[str] = []

    def execute(request: Request) -> None:
        if request.topic == "cmd/arm":
            bus.answer({request.id: Answer(True, "armed")})
        elif request.topic == "cmd/heading":
            vector = codec.decoded(request.payload, codec.VECTOR_SCHEMA).vector
            velocity_mps, heading_rad = vector.x, vector.z
            state["x"] += 0.1 * velocity_mps * math.cos(heading_rad)
            state["y"] += 0.1 * velocity_mps * math.sin(heading_rad)
        elif request.topic == "cmd/twist":
            stops.append(request.topic)

    with robot() as (bus, endpoint):
        bus.subscribe_commands(execute)
        code = docstring_code(Driver.__doc__).replace('Robot("omnid")', f'Robot("omnid", connect=("{endpoint}",))')
        with script(f"print('ready', flush=True)\n{code}") as process:

            def run() -> bool:
                T = se3.transform(np.eye(3), [state["x"], state["y"], 0.0])
                bus.publish(
                    "odom",
                    codec.odometry_cdr(time.time_ns(), T, np.eye(6), np.zeros(6), np.eye(6)),
                    PoseAttachment(1, "tracking").to_bytes(),
                )
                return process.poll() is not None

            wait_until(run, pause_s=0.005)
            assert process.returncode == 0
        wait_until(lambda: bool(stops))
    assert math.hypot(state["x"] - 1.0, state["y"] - 1.0) < 0.15


def test_the_driver_sends_commands() -> None:
    received: list[Request] = []
    freshness = Freshness(60.0)
    with robot() as (bus, endpoint), Robot(connect=(endpoint,)) as connection:
        bus.serve("time", freshness.own_time)
        driver = connection.driver()
        with pytest.raises(OmnidError, match="receives commands"):
            driver.require_connected()
        bus.subscribe_commands(received.append)
        driver.require_connected()
        driver.twist(0.5, -0.25)
        driver.heading(0.75, 1.5)
        wait_until(lambda: len(received) == 2)
        driver.stop()
        wait_until(lambda: len(received) == 3)
        before_ns = time.time_ns()
        with pytest.raises(OmnidError, match="has not answered"):
            driver.arm(timeout_s=0.2)
        wait_until(lambda: len(received) == 4)
        connection.driver("planner").twist(0.5, -0.25)
        wait_until(lambda: len(received) == 5)
        with Robot(connect=(endpoint,)) as other:
            other.driver().stop()
            wait_until(lambda: len(received) == 6)
    received[:2] = sorted(received[:2], reverse=True)  # the order of different topics is not kept
    twist, heading, stop, arm, planned, other_stop = received
    topics = [f"cmd/{name}" for name in ("twist", "heading", "stop", "arm", "planner/twist", "stop")]
    assert [request.topic for request in received] == topics
    for request in (twist, planned):
        assert codec.twist_from_cdr(request.payload)[1:4] == ("base_link", 0.5, -0.25)
    sent = codec.decoded(heading.payload, codec.VECTOR_SCHEMA)
    assert (sent.header.frame_id, sent.vector.x, sent.vector.z) == ("odom", 0.75, 1.5)
    assert before_ns <= arm.sent_ns <= time.time_ns()
    senders = {request.sender for request in (twist, heading, stop, planned)}
    assert len(senders) == 1 and other_stop.sender not in senders and len(other_stop.sender) >= 16
    # Each says when it was sent by the robot's own time, whatever the clock of this computer.
    for request in received:
        freshness.require(Request(request.topic, echo_ns=request.echo_ns), time.monotonic_ns())
    assert [r.echo_ns for r in received[2:]] == sorted(r.echo_ns for r in received[2:])


def packet(kind: int, *numbers: int) -> bytes:
    """Return a packet of the IMU with four numbers."""
    body = struct.pack("<BB4h", 0x55, kind, *numbers)
    return body + bytes([sum(body) & 0xFF])


def test_a_serial_gyro_is_published_on_the_bus() -> None:
    device, host = os.openpty()
    tty.setraw(host)
    endpoint, received = free_endpoint(), list[bytes]()
    damaged = bytearray(packet(0x52, 1, 2, 3, 0))
    damaged[5] ^= 1
    # Acceleration, angular velocity of (0, -3, 16384) units, a damaged packet and a lost start.
    turn = (
        packet(0x51, 1, 2, 2048, 2000) + packet(0x52, 0, -3, 16384, 0) + bytes(damaged) + packet(0x53, 5, 6, 7, 0)[4:]
    )
    words = ("omnid.examples.serial_gyro", os.ttyname(host), "--robot", "rover", "--connect", endpoint)
    with session(mode="router", listen__endpoints=[endpoint]) as router:
        router.declare_subscriber("rover/cmd/imu", lambda sample: received.append(sample.payload.to_bytes()))
        program = subprocess.Popen([sys.executable, "-m", *words], cwd=ROOT, stderr=subprocess.PIPE)
        try:
            wait_until(lambda: os.write(device, turn) and len(received) >= 10, pause_s=0.02)
        finally:
            os.close(host)
            os.close(device)  # the device is unplugged
        _, errors = program.communicate(timeout=20.0)
    samples = [sample_from_cdr(payload, IMU_SCHEMA, lambda unix_ns: unix_ns) for payload in received]
    assert len(samples) >= 10 and program.returncode == 1 and b"Traceback" not in errors
    for sample in samples:
        assert isinstance(sample, GyroSample) and not sample.of_base, "the robot's settings turn its axes"
        assert sample.x_radps == 0.0 and sample.z_radps == pytest.approx(math.radians(1000.0)), "half of 2000 deg/s"
        assert sample.y_radps == pytest.approx(-3 * math.radians(2000.0) / 32768)


STEP_NS, STAND, STEP_M, DISTANCE_M, NOISE_M = 10**8, 40, 0.05, 12.0, 1e-3


def write_rounds(path: Path, scales: tuple[float, ...]) -> None:
    """Write a trajectory of rounds, each with its own scale, and a pause half-way."""
    there = np.arange(0, DISTANCE_M + 1e-9, STEP_M)
    there = np.insert(there, len(there) // 2, [there[len(there) // 2]] * 50)
    round_m = np.concatenate([there, np.full(STAND, DISTANCE_M), there[::-1], np.zeros(STAND)])
    way_m = np.concatenate([np.zeros(STAND), *(scale * round_m for scale in scales)])
    noise = NOISE_M * np.random.default_rng(1).standard_normal((len(way_m), 2))
    poses = planar_poses(np.column_stack([way_m, np.zeros(len(way_m))]) + noise, np.zeros(len(way_m)))
    stamps_ns = 1_700_000_000 * 10**9 + STEP_NS * np.arange(len(way_m))
    path.write_text("\n".join(tum_row(int(stamp), T) for stamp, T in zip(stamps_ns, poses, strict=True)))


@pytest.mark.parametrize(
    ("scales", "code", "longest"),
    [((1.0, 1.0, 1.0), 0, "+0.0"), ((1.02, 0.98), 1, "+2.0")],  # the latter is right in the mean only
)
def test_the_errors_of_rounds_are_measured(
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    scales: tuple[float, ...],
    code: int,
    longest: str,
) -> None:
    path = tmp_path / "est.txt"
    write_rounds(path, scales)
    monkeypatch.setattr("sys.argv", ["acceptance", str(path), str(DISTANCE_M)])
    with pytest.raises(SystemExit) as ended:
        runpy.run_module("omnid.examples.acceptance", run_name="__main__")
    out = capsys.readouterr().out
    assert ended.value.code == code, out
    assert out.count("round of ") == len(scales) and out.count(" to ") == 2 * len(scales)
    errors = re.findall(r"m, ([+-]\d+\.\d)", out)
    assert max(errors, key=float).startswith(longest), out
