"""`omnid view` in a process of its own: a robot on the bus, and a browser that looks."""

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
from omnid.transport import codec
from omnid.transport.bus import Bus, BusConfig
from omnid.transport.codec import DiagnosticStatus
from omnid.transport.features_attachment import features_to_bytes
from omnid.transport.image_codec import image_cdr
from omnid.transport.pose_attachment import PoseAttachment
from tests.omnid.transport.bus_fixtures import DEADLINE_S, free_endpoint
from tests.omnid.viewer.rrd import need_rerun, positions, rows, verified
from tests.omnid.viewer.test_view import START_NS, made


@contextlib.contextmanager
def viewing(home: Path, *words: object) -> Iterator[subprocess.Popen[str]]:
    """`omnid view` of somebody whose settings are in a folder of their own."""
    environment = os.environ | {"HOME": str(home), "XDG_CONFIG_HOME": str(home / "config")}
    with subprocess.Popen([sys.executable, "-m", "omnid", "view", *map(str, words)], stdout=subprocess.PIPE,
                          stderr=subprocess.PIPE, text=True, env=environment) as process:
        try:
            yield process
        finally:
            process.kill()


def say(bus: Bus, number: int) -> None:
    """Poses, one of them broken, a image, a map, reports."""
    stamp_ns, T = START_NS + number * 10**7, se3.transform(np.eye(3), [0.01 * number, 0.5, 0.0])
    pose = codec.odometry_cdr(stamp_ns, T, 1e-6 * np.eye(6), np.zeros(6), np.eye(6))
    bus.publish("odom", pose if number % 7 else b"nonsense",
                PoseAttachment(number, "degraded", 0, 50, 60, time.time_ns()).to_bytes())
    bus.publish("cloud", codec.point_cloud_cdr(stamp_ns, "odom", np.ones((5, 3)), np.ones(5)))
    said = [DiagnosticStatus("omnid: stage odometry", 0, "", {"work_p50_ms": "30.5"})]
    bus.publish("status", codec.diagnostics_cdr(stamp_ns, said))
    jpeg = cv2.imencode(".jpg", np.zeros((8, 16), np.uint8))[1]
    pixels = {"inliers": np.array([[3.0, 4.0], [5.0, 6.0]]), "rejected": np.ones((1, 2)), "new": np.zeros((0, 2))}
    bus.publish("panorama", image_cdr(Frame(number, stamp_ns, "lower", "jpeg", jpeg), stamp_ns)[1],
                features_to_bytes(pixels) if number % 5 else b"nonsense")


def test_a_robot_is_drawn_as_it_speaks(tmp_path: Path) -> None:
    need_rerun()
    endpoint, out = free_endpoint(), tmp_path / "live.rrd"
    speaking = contextlib.closing(Bus(BusConfig(robot="rover", listen=(endpoint,))))
    looking = viewing(tmp_path, "--robot", "rover", "--connect", endpoint, "-o", out, "--seconds", 2)
    with speaking as bus, looking as it:
        deadline_s = time.monotonic() + DEADLINE_S
        for number in count():
            say(bus, number)
            time.sleep(0.01)
            if it.poll() is not None:
                break
            assert time.monotonic() < deadline_s
        said, warned = it.communicate()
    assert it.returncode == 0 and warned == "" and "poses and" in said
    stamps_ns, xyz = positions(out)
    numbers = (stamps_ns - START_NS) // 10**7
    assert len(numbers) > 20 and (np.diff(numbers) > 0).all() and not (numbers % 7 == 0).any()
    np.testing.assert_allclose(xyz, np.column_stack([0.01 * numbers, 0.5 + 0 * numbers, 0 * numbers]), atol=1e-5)
    assert rows(out, "/state", "StateChange:state")[0].value == ["degraded"]
    assert rows(out, "/latency/odometry", "Scalars:scalars")[0].value == [30.5]
    assert np.allclose(rows(out, "/panorama/agreeing", "Points2D:positions")[0].value, [[3, 4], [5, 6]])
    assert rows(out, "/panorama", "EncodedImage:blob") and rows(out, "/odom/map", "Points3D:positions")
    assert verified(out)


def test_a_robot_that_is_not_there_is_told(tmp_path: Path) -> None:
    need_rerun()
    endpoint = free_endpoint()
    with viewing(tmp_path, "--connect", endpoint, "-o", tmp_path / "x.rrd") as it:
        said, told = it.communicate(timeout=DEADLINE_S)
    assert it.returncode == 2 and said == "" and endpoint in told and told.count("\n") == 1
    assert not (tmp_path / "x.rrd").exists()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_browser_of_this_machine_is_served_until_a_signal(tmp_path: Path, number: signal.Signals) -> None:
    need_rerun()
    with viewing(tmp_path, made(tmp_path / "made.mcap"), "--web") as it:
        assert it.stderr is not None
        lines = [it.stderr.readline() for _ in range(3)]
        found = re.search(r"http://127\.0\.0\.1:(\d+)/\S+127\.0\.0\.1%3A(\d+)%2Fproxy", lines[0])
        assert found, lines
        with urllib.request.urlopen(found[0], timeout=DEADLINE_S) as page:
            assert page.status == 200 and b"rerun" in page.read().lower()
        assert "Ctrl-C" in lines[2]
        it.send_signal(number)
        said, _ = it.communicate(timeout=DEADLINE_S)
    assert it.returncode == 0 and said.startswith("3 poses")
    for port in map(int, found.groups()):
        with socket.socket() as probe:
            assert probe.connect_ex(("127.0.0.1", port)) != 0
    settings = json.loads((tmp_path / "config" / "rerun" / "analytics.json").read_text())
    assert settings["analytics_enabled"] is False


@pytest.mark.slow  # the viewer takes its time to find out
def test_a_viewer_that_finds_no_screen_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    need_rerun()
    monkeypatch.setenv("DISPLAY", ":4711")
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    with viewing(tmp_path, made(tmp_path / "made.mcap")) as it:
        _, told = it.communicate(timeout=DEADLINE_S)
    assert it.returncode == 2 and "-o FILE.rrd" in told.splitlines()[-1]
