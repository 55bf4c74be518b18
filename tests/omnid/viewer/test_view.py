"""`omnid view` and `omnid replay --rerun`, read back with rerun's own reader; the layout for Foxglove."""

from __future__ import annotations

import contextlib
import io
import json
import re
import sys
import time
from importlib.resources import files
from itertools import count
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from calib import se3
from drivers.frame import Frame
from omnid.formats.tum import read_tum
from omnid.transport import codec
from omnid.transport.bus import Bus, BusConfig
from omnid.transport.codec import DiagnosticStatus, PoseAttachment
from omnid.transport.sensor_codec import image_cdr
from omnid.transport.status_names import STAGE_PREFIX
from omnid.transport.topics import PUBLISHED, ros_name
from tests.conftest import PAIRS
from tests.omnid.transport.bus_fixtures import DEADLINE_S, free_endpoint
from tests.replay.command import Command
from tests.waiting import OMNID, running

WITHOUT = "needs rerun: pip install 'rerun-sdk>=0.41'"


class Row(NamedTuple):
    """A value of an entity and its stamp."""

    stamp_ns: int
    value: Any  # a list, one element per instance


def need_rerun() -> None:
    """Skip the calling test where rerun is not installed."""
    pytest.importorskip("rerun", reason=WITHOUT)


def rows(path: Path, entity: str, component: str) -> list[Row]:
    """Return all values of a component in the order of their stamps, without static ones."""
    from rerun.chunk import RrdReader

    found = []
    for chunk in RrdReader(str(path)).stream():
        if chunk.entity_path == entity and not chunk.is_static:
            table = chunk.to_record_batch()
            if component in table.schema.names:
                stamps_ns = table.column("stamp").cast("int64").to_pylist()
                found += map(Row, stamps_ns, table.column(component).to_pylist())
    return sorted(found, key=lambda row: row.stamp_ns)


def positions(path: Path) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return stamps [ns] and positions (N, 3) [m] of the robot."""
    found = rows(path, "/odom/base_link", "Transform3D:translation")
    return np.array([row.stamp_ns for row in found]), np.array([row.value[0] for row in found])


START_NS = 10**18
pytestmark = pytest.mark.usefixtures("default_signals")


@pytest.fixture(scope="module")
def drawn(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with the same log replayed, recorded and drawn."""
    need_rerun()
    from omnid.cli import main

    folder = tmp_path_factory.mktemp("drawn")
    log = [str(scene / "log.mcap"), "--rig", str(scene / "rig.toml"), "--quiet"]
    assert main(["replay", *log, "--tum", str(folder / "est.txt"), "--record", str(folder / "rec.mcap")]) == 0
    with contextlib.redirect_stdout(io.StringIO()) as printed:
        assert main(["replay", *log, "--rerun", str(folder / "out.rrd")]) == 0
    assert f"written   {folder / 'out.rrd'}\n" in printed.getvalue()
    return folder


def test_the_path_is_that_of_the_tum_file(drawn: Path) -> None:
    estimate = read_tum(drawn / "est.txt")
    stamps_ns, xyz = positions(drawn / "out.rrd")
    assert np.array_equal(stamps_ns, estimate.stamps_ns)
    np.testing.assert_allclose(xyz, estimate.T[:, :3, 3], atol=1e-6)
    pieces = [row.value[0] for row in rows(drawn / "out.rrd", "/odom/path", "LineStrips3D:strips")]
    np.testing.assert_allclose([piece[1] for piece in pieces], estimate.T[:, :3, 3], atol=1e-6)
    np.testing.assert_allclose([piece[0] for piece in pieces[1:]], [piece[1] for piece in pieces[:-1]], atol=0)


def test_the_viewer_shows_a_recording(drawn: Path, omnid: Command) -> None:
    code, out, _ = omnid("view", drawn / "rec.mcap", "-o", drawn / "rec.rrd")
    assert code == 0 and out.startswith(f"{PAIRS} poses and 0 images shown\n")
    for ours, recorded in zip(positions(drawn / "out.rrd"), positions(drawn / "rec.rrd"), strict=True):
        np.testing.assert_allclose(ours, recorded, atol=1e-6)
    clouds = [rows(drawn / name, "/odom/map", "Points3D:positions")[-1].value for name in ("out.rrd", "rec.rrd")]
    np.testing.assert_allclose(clouds[0], clouds[1], atol=1e-6)
    assert [row.value for row in rows(drawn / "rec.rrd", "/state", "StateChange:state")] == [["tracking"]]


def test_without_rerun_the_installation_is_named(scene: Path, omnid: Command, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "rerun", None)
    assert f"{sys.executable} -m pip install 'rerun-sdk" in omnid.refused("view", scene / "log.mcap", "-o", "x.rrd")


def publish(bus: Bus, number: int) -> None:
    """Publish a pose, an image, a map and a status; some are damaged."""
    stamp_ns, T = START_NS + number * 10**7, se3.transform(np.eye(3), [0.01 * number, 0.5, 0.0])
    pose = codec.odometry_cdr(stamp_ns, T, 1e-6 * np.eye(6), np.zeros(6), np.eye(6))
    bus.publish(
        "odom",
        pose if number % 7 else b"nonsense",
        PoseAttachment(number, "degraded", 0, 50, 60, time.time_ns()).to_bytes(),
    )
    bus.publish("cloud", codec.point_cloud_cdr(stamp_ns, "odom", np.ones((5, 3)), np.ones(5)))
    statuses = [DiagnosticStatus(f"{STAGE_PREFIX}odometry", 0, "", {"work_p50_ms": "30.5"})]
    bus.publish("status", codec.diagnostics_cdr(stamp_ns, statuses))
    jpeg = cv2.imencode(".jpg", np.zeros((8, 16), np.uint8))[1]
    bus.publish(
        "panorama",
        image_cdr(Frame(number, stamp_ns, "lower", "jpeg", jpeg), stamp_ns)[1],
    )


def test_the_viewer_draws_the_messages_of_a_robot(tmp_path: Path) -> None:
    need_rerun()
    endpoint, drawn = free_endpoint(), tmp_path / "live.rrd"
    publishing = contextlib.closing(Bus(BusConfig(robot="rover", listen=(endpoint,))))
    words = ("view", "--robot", "rover", "--connect", endpoint, "-o", drawn, "--seconds", 2)
    home = {"DISPLAY": "", "WAYLAND_DISPLAY": "", "HOME": str(tmp_path), "XDG_CONFIG_HOME": str(tmp_path / "config")}
    with publishing as bus, running([*OMNID, *words], home) as viewer:
        deadline_s = time.monotonic() + DEADLINE_S
        for number in count():
            publish(bus, number)
            time.sleep(0.01)
            if viewer.poll() is not None:
                break
            assert time.monotonic() < deadline_s
        out, err = viewer.communicate()
    assert viewer.returncode == 0 and err == "" and "poses and" in out
    stamps_ns, xyz = positions(drawn)
    numbers = (stamps_ns - START_NS) // 10**7
    assert len(numbers) > 20 and (np.diff(numbers) > 0).all() and not (numbers % 7 == 0).any()
    np.testing.assert_allclose(xyz, np.column_stack([0.01 * numbers, 0.5 + 0 * numbers, 0 * numbers]), atol=1e-5)
    assert rows(drawn, "/state", "StateChange:state")[0].value == ["degraded"]
    assert rows(drawn, "/panorama", "EncodedImage:blob") and rows(drawn, "/odom/map", "Points3D:positions")


def panels(node: Any) -> list[str]:
    """Return the panels of a layout tree."""
    return [node] if isinstance(node, str) else panels(node["first"]) + panels(node["second"])


def test_the_layout_shows_topics_of_the_robot() -> None:
    text = (files("omnid.viewer") / "foxglove.json").read_text()
    layout = json.loads(text)
    assert sorted(panels(layout["layout"])) == sorted(layout["configById"])
    named = {name.partition(".")[0] for name in re.findall(r'"(/omnid/[^"]+)"', text)}
    assert named and named <= {ros_name("omnid", topic) for topic in PUBLISHED}
