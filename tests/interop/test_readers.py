"""Recordings, read by programs of other projects: @mcap/core under node, evo."""

from __future__ import annotations

import hashlib
import json
import math
import os
import shutil
import subprocess
from collections.abc import Iterator, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import pytest
from mcap.writer import CompressionType
from rosbags.highlevel import AnyReader

from calib import se3
from drivers.frame import Frame
from drivers.logs.mcap_writer import LogWriter
from omnid.transport import codec
from omnid.transport.codec import DiagnosticStatus
from omnid.transport.sensor_codec import image_cdr, image_topic
from omnid.transport.status_names import ODOMETRY, Key
from tests.drivers.logs.mcap_logs import STORE
from tests.replay.live import recorded_run

pytestmark = pytest.mark.interop

START_NS = 1_700_000_000 * 10**9 + 123_456_789
PERIOD_NS = 33_333_333
COUNT = 7
ATTACHED = {"rig.toml": b"schema = 1\n", "omnid.toml": b"a = 1\n"}
CLOUD = "sensor_msgs/msg/PointCloud2"

NOT_FINITE = {"nan": "NaN", "inf": "Infinity", "-inf": "-Infinity"}  # JavaScript's words: JSON has no such numbers

Expected = dict[str, list[dict[str, Any]]]  # topic -> its messages, in order


def write_known(path: Path, compression: CompressionType = CompressionType.LZ4) -> Expected:
    """Write the log with omnid's own writers and return its expected content."""
    numbers = np.random.default_rng(5)
    expected: Expected = {}
    with closing(LogWriter(path, ATTACHED, compression=compression)) as log:
        for stamp_ns in range(START_NS, START_NS + COUNT * PERIOD_NS, PERIOD_NS):
            for topic, schema, data in _messages(stamp_ns, numbers):
                log.write(topic, schema, data, stamp_ns)
                expected.setdefault(topic, []).append(plain(STORE.deserialize_cdr(data, schema)))
    return expected


def digest(data: bytes) -> dict[str, Any]:
    """Return length and SHA-256 of bytes."""
    return {"bytes": len(data), "sha256": hashlib.sha256(data).hexdigest()}


def plain(value: Any) -> Any:
    """Return a message of rosbags as nested dicts and lists."""
    if isinstance(value, np.ndarray):
        return digest(value.tobytes()) if value.dtype == np.uint8 else plain(value.tolist())
    if isinstance(value, list):
        return [plain(entry) for entry in value]
    if isinstance(value, float) and not math.isfinite(value):
        return NOT_FINITE[str(value)]
    if not hasattr(value, "__dataclass_fields__"):
        return value
    fields = [name for name in value.__dataclass_fields__ if not name.isupper()]  # constants are upper case
    found = {name: plain(getattr(value, name)) for name in fields if name != "__msgtype__"}
    if value.__msgtype__ == CLOUD:
        found["points"] = value.data.view("<f4").reshape(-1, value.point_step // 4).astype(float).tolist()
    return found


def _messages(stamp_ns: int, numbers: np.random.Generator) -> Iterator[tuple[str, str, bytes]]:
    """Yield topic, type and bytes of a message of each kind; the lower camera's image is a JPEG, the upper's is raw."""
    T, twist = se3.exp(numbers.normal(size=6)), numbers.normal(size=6)
    one, other = (0.01 * factor @ factor.T for factor in numbers.normal(size=(2, 6, 6)))
    packed = numbers.normal(size=(50, 4)).astype("<f4")
    pixels = numbers.integers(0, 256, (24, 32), dtype=np.uint8)
    status = DiagnosticStatus(ODOMETRY, 1, "über 90 °C", {Key.INLIERS: "3"})
    yield "/omnid/odom", codec.ODOMETRY_SCHEMA, codec.odometry_cdr(stamp_ns, T, one, twist, other)
    yield "/omnid/pose", codec.POSE_SCHEMA, codec.encoded(codec.POSE_SCHEMA, (stamp_ns, "odom"), T)
    yield "/tf", codec.TRANSFORM_SCHEMA, codec.transform_cdr(stamp_ns, [("odom", "base_link", T)])
    yield "/omnid/drive", codec.TWIST_SCHEMA, codec.twist_stamped_cdr(stamp_ns, "base_link", twist[0], twist[5])
    yield "/omnid/status", codec.DIAGNOSTICS_SCHEMA, codec.diagnostics_cdr(stamp_ns, [status])
    yield "/omnid/cloud", CLOUD, codec.point_cloud_cdr(stamp_ns, "odom", packed[:, :3], packed[:, 3])
    jpeg = cv2.imencode(".jpg", pixels)[1].tobytes()
    frames = Frame(0, stamp_ns, "lower", "jpeg", jpeg), Frame(0, stamp_ns, "upper", "mono8", pixels, 32, 24)
    for frame in frames:
        yield f"/omnid/{image_topic(frame)}", *image_cdr(frame, stamp_ns)


HERE = Path(__file__).parent
TIMEOUT_S = 300.0
NPM = ("package.json", "read_log.mjs")


def run(words: Sequence[object], folder: Path) -> str:
    """Return the stdout of a program; raise AssertionError with its stderr where it fails."""
    done = subprocess.run(
        [str(word) for word in words],
        cwd=folder,
        capture_output=True,
        text=True,
        timeout=TIMEOUT_S,
    )
    assert done.returncode == 0, f"{words}: {done.stderr[-2000:]}"
    return done.stdout


def lines(words: Sequence[object], folder: Path) -> list[Any]:
    """Return the stdout of a program, parsed as JSON line by line."""
    return [json.loads(line) for line in run(words, folder).splitlines()]


def program(name: str, package: str) -> Path:
    """Return the path of a program on the PATH."""
    found = shutil.which(name)
    if found is None:
        pytest.skip(
            f"{name} is not on the PATH: python3 -m venv VENV && VENV/bin/pip install {package}, then "
            "PATH=VENV/bin:$PATH"
        )
    return Path(found)


def npm_reader() -> Path:
    """Return read_log.mjs beside the packages of package.json, which are installed at the first use.

    In $OMNID_INTEROP_CACHE, else in ~/.cache/omnid-interop.
    """
    if not shutil.which("node") or not shutil.which("npm"):
        pytest.skip("node or npm is not on the PATH: apt install nodejs npm (node 18 or newer)")
    folder = Path(os.environ.get("OMNID_INTEROP_CACHE") or Path.home() / ".cache" / "omnid-interop")
    wanted = (HERE / "package.json").read_bytes()
    fresh = not (folder / "node_modules").is_dir() or (folder / "package.json").read_bytes() != wanted
    folder.mkdir(parents=True, exist_ok=True)
    for name in NPM:
        shutil.copyfile(HERE / name, folder / name)
    if fresh:
        _install(folder)
    return folder / "read_log.mjs"


def _install(folder: Path) -> None:
    """Install the packages without running their scripts and without a lock file."""
    words = ["npm", "install", "--no-audit", "--no-fund", "--no-package-lock", "--ignore-scripts"]
    try:
        run(words, folder)
    except (AssertionError, subprocess.TimeoutExpired) as error:
        shutil.rmtree(folder / "node_modules", ignore_errors=True)
        pytest.skip(f"the packages of {HERE / 'package.json'} cannot be installed: {error}")


POSES = 12  # of the live run


class Known(NamedTuple):
    """A log and its expected content."""

    path: Path
    expected: Expected


@pytest.fixture(scope="session", params=(CompressionType.LZ4, CompressionType.NONE), ids=["lz4", "none"])
def known(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Known:
    """A log of known numbers, with chunks as `--record` and as `omnid run` writes them."""
    path = tmp_path_factory.mktemp("known") / f"{request.param}.mcap"
    return Known(path, write_known(path, request.param))


@pytest.fixture(scope="session")
def live(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The recording of a live run: images, poses, map, states, commands to the wheels."""
    return recorded_run(scene, tmp_path_factory.mktemp("live"), POSES)


def read_by_node(log: Path) -> tuple[dict[str, Any], Expected]:
    """Return the header of the log and its messages by topic; assert that log times are the stamps."""
    reader = npm_reader()
    head, *messages = lines(["node", reader, log], reader.parent)
    found: Expected = {}
    for entry in messages:
        message = entry["message"]
        if "/cmd/" not in entry["topic"]:
            stamp = message.get("transforms", [message])[0]["header"]["stamp"]
            assert int(entry["log_ns"]) == stamp["sec"] * 10**9 + stamp["nanosec"]
        found.setdefault(entry["topic"], []).append(message)
    return head, found


def test_others_read_the_numbers_that_were_written(known: Known) -> None:
    head, found = read_by_node(known.path)
    assert head == {"profile": "ros2", "attachments": {name: digest(data) for name, data in ATTACHED.items()}}
    assert found == known.expected


def test_the_reader_reads_a_live_recording_as_rosbags_does(live: Path) -> None:
    expected: Expected = {}
    with AnyReader([live]) as bag:
        for place, _, data in bag.messages():
            expected.setdefault(place.topic, []).append(plain(bag.deserialize(data, place.msgtype)))
    head, found = read_by_node(live)
    assert set(head["attachments"]) == {"rig.toml", "omnid.toml"} and len(found) >= 8
    assert found == expected


@pytest.mark.parametrize("topic", ["odom", "pose"])
def test_others_read_the_poses_that_were_written(known: Known, tmp_path: Path, topic: str) -> None:
    found = trajectory(known.path, tmp_path, topic)
    wanted = known.expected[f"/omnid/{topic}"]
    assert len(found) == len(wanted)
    for row, message in zip(found, wanted, strict=True):
        pose, stamp = message["pose"]["pose"] if topic == "odom" else message["pose"], message["header"]["stamp"]
        numbers = [*pose["position"].values(), *pose["orientation"].values()]
        np.testing.assert_allclose(row[1:], numbers, rtol=0, atol=1e-12)
        assert row[0] == pytest.approx(stamp["sec"] + 1e-9 * stamp["nanosec"], rel=0, abs=1e-6)


def trajectory(log: Path, folder: Path, topic: str) -> np.ndarray:
    """Return rows t x y z qx qy qz qw, as read and saved by evo."""
    run([program("evo_traj", "evo"), "mcap", log, f"/omnid/{topic}", "--save_as_tum"], folder)
    return np.atleast_2d(np.loadtxt(folder / f"omnid_{topic}.tum"))
