"""`omnid view` in a process of its own: of a robot on the bus, and in a browser."""

from __future__ import annotations

import contextlib
import json
import os
import re
import signal
import socket
import subprocess
import sys
import time
import urllib.request
from collections.abc import Iterator
from itertools import count
from pathlib import Path

import cv2
import numpy as np
import pytest

from calib import se3
from drivers.frame import Frame
from omnid.transport import codec, map_codec
from omnid.transport.bus import Bus, BusConfig
from omnid.transport.features_attachment import features_to_bytes
from omnid.transport.image_codec import image_cdr
from omnid.transport.pose_attachment import PoseAttachment
from omnid.transport.records import DiagnosticStatus
from omnid.transport.status_names import stage_name
from tests.omnid.transport.bus_fixtures import DEADLINE_S, free_endpoint
from tests.omnid.viewer.rrd import need_rerun, positions, rows, verified
from tests.omnid.viewer.test_view import START_NS, made

pytestmark = pytest.mark.usefixtures("default_signals")


@contextlib.contextmanager
def viewing(home: Path, *words: object) -> Iterator[subprocess.Popen[str]]:
    """Run `omnid view` with a home folder of its own."""
    environment = os.environ | {"HOME": str(home), "XDG_CONFIG_HOME": str(home / "config")}
    with subprocess.Popen(
        [sys.executable, "-m", "omnid", "view", *map(str, words)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=environment,
    ) as process:
        try:
            yield process
        finally:
            process.kill()


def publish(bus: Bus, number: int) -> None:
    """Publish a pose, an image, a map and a status; some are damaged."""
    stamp_ns, T = START_NS + number * 10**7, se3.transform(np.eye(3), [0.01 * number, 0.5, 0.0])
    pose = codec.odometry_cdr(stamp_ns, T, 1e-6 * np.eye(6), np.zeros(6), np.eye(6))
    bus.publish(
        "odom",
        pose if number % 7 else b"nonsense",
        PoseAttachment(number, "degraded", 0, 50, 60, time.time_ns()).to_bytes(),
    )
    bus.publish("map_pose", codec.pose_with_covariance_cdr(stamp_ns, se3.exp([0.2, 0, 0, 0, 0, 0]) @ T, np.eye(6)))
    bus.publish("cloud", map_codec.point_cloud_cdr(stamp_ns, "odom", np.ones((5, 3)), np.ones(5)))
    statuses = [DiagnosticStatus(stage_name("odometry"), 0, "", {"work_p50_ms": "30.5"})]
    bus.publish("status", codec.diagnostics_cdr(stamp_ns, statuses))
    jpeg = cv2.imencode(".jpg", np.zeros((8, 16), np.uint8))[1]
    pixels = {"inliers": np.array([[3.0, 4.0], [5.0, 6.0]]), "rejected": np.ones((1, 2)), "new": np.zeros((0, 2))}
    bus.publish(
        "panorama",
        image_cdr(Frame(number, stamp_ns, "lower", "jpeg", jpeg), stamp_ns)[1],
        features_to_bytes(pixels) if number % 5 else b"nonsense",
    )


def test_draws_the_messages_of_a_robot(tmp_path: Path) -> None:
    need_rerun()
    endpoint, drawn = free_endpoint(), tmp_path / "live.rrd"
    publishing = contextlib.closing(Bus(BusConfig(robot="rover", listen=(endpoint,))))
    viewer = viewing(tmp_path, "--robot", "rover", "--connect", endpoint, "-o", drawn, "--seconds", 2)
    with publishing as bus, viewer as it:
        deadline_s = time.monotonic() + DEADLINE_S
        for number in count():
            publish(bus, number)
            time.sleep(0.01)
            if it.poll() is not None:
                break
            assert time.monotonic() < deadline_s
        out, err = it.communicate()
    assert it.returncode == 0 and err == "" and "poses and" in out
    stamps_ns, xyz = positions(drawn)
    numbers = (stamps_ns - START_NS) // 10**7
    assert len(numbers) > 20 and (np.diff(numbers) > 0).all() and not (numbers % 7 == 0).any()
    np.testing.assert_allclose(xyz, np.column_stack([0.01 * numbers, 0.5 + 0 * numbers, 0 * numbers]), atol=1e-5)
    assert rows(drawn, "/state", "StateChange:state")[0].value == ["degraded"]
    assert rows(drawn, "/latency/odometry", "Scalars:scalars")[0].value == [30.5]
    corrections = rows(drawn, "/correction/position\\ mm", "Scalars:scalars")
    assert corrections and corrections[0].value == [pytest.approx(200.0)]
    assert np.allclose(rows(drawn, "/panorama/inliers", "Points2D:positions")[0].value, [[3, 4], [5, 6]])
    assert rows(drawn, "/panorama", "EncodedImage:blob") and rows(drawn, "/odom/map", "Points3D:positions")
    assert verified(drawn)


def test_reports_a_robot_that_cannot_be_reached(tmp_path: Path) -> None:
    need_rerun()
    endpoint = free_endpoint()
    with viewing(tmp_path, "--connect", endpoint, "-o", tmp_path / "x.rrd") as it:
        out, err = it.communicate(timeout=DEADLINE_S)
    assert it.returncode == 2 and out == "" and endpoint in err and err.count("\n") == 1
    assert not (tmp_path / "x.rrd").exists()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_serves_a_browser_until_a_signal(tmp_path: Path, number: signal.Signals) -> None:
    need_rerun()
    named = int(free_endpoint().rpartition(":")[2])
    with viewing(tmp_path, made(tmp_path / "made.mcap"), "--web", "--port", str(named)) as it:
        assert it.stderr is not None
        lines = [it.stderr.readline() for _ in range(3)]
        found = re.search(r"http://127\.0\.0\.1:(\d+)/\S+127\.0\.0\.1%3A(\d+)%2Fproxy", lines[0])
        assert found and list(map(int, found.groups())) == [named, named + 1], lines
        with urllib.request.urlopen(found[0], timeout=DEADLINE_S) as page:
            assert page.status == 200 and b"rerun" in page.read().lower()
        assert "Ctrl-C" in lines[2]
        it.send_signal(number)
        out, _ = it.communicate(timeout=DEADLINE_S)
    assert it.returncode == 0 and out.startswith("3 poses")
    for port in map(int, found.groups()):
        with socket.socket() as probe:
            assert probe.connect_ex(("127.0.0.1", port)) != 0
    settings = json.loads((tmp_path / "config" / "rerun" / "analytics.json").read_text())
    assert settings["analytics_enabled"] is False


@pytest.mark.slow  # the viewer needs seconds to detect it
def test_reports_a_viewer_without_a_screen(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    need_rerun()
    monkeypatch.setenv("DISPLAY", ":4711")
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    with viewing(tmp_path, made(tmp_path / "made.mcap")) as it:
        _, err = it.communicate(timeout=DEADLINE_S)
    assert it.returncode == 2 and "-o FILE.rrd" in err.splitlines()[-1]
