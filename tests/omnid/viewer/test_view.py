"""`omnid view`: its drawings, read back with rerun's own reader, and its errors."""

from __future__ import annotations

import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from calib import se3
from drivers.frame import Frame
from drivers.logs.mcap_writer import LogWriter
from omnid.formats.tum import read_tum
from omnid.transport import codec
from omnid.transport.image_codec import image_cdr
from omnid.transport.records import DiagnosticStatus
from omnid.transport.status_names import ODOMETRY
from tests.conftest import PAIRS
from tests.omnid.viewer.rrd import entities, need_rerun, positions, rows, verified
from tests.replay.command import Command
from tests.simulation import build, write_log

START_NS = 10**18


@pytest.fixture(scope="module")
def drawn(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with the same log replayed, recorded and drawn."""
    need_rerun()
    from omnid.cli import main

    folder = tmp_path_factory.mktemp("drawn")
    log = [str(scene / "log.mcap"), "--rig", str(scene / "rig.toml"), "--quiet"]
    assert main(["replay", *log, "--tum", str(folder / "est.txt"), "--record", str(folder / "rec.mcap")]) == 0
    assert main(["view", *log, "-o", str(folder / "out.rrd")]) == 0
    return folder


def test_the_path_is_that_of_the_tum_file(drawn: Path) -> None:
    estimate = read_tum(drawn / "est.txt")
    stamps_ns, xyz = positions(drawn / "out.rrd")
    assert np.array_equal(stamps_ns, estimate.stamps_ns)
    np.testing.assert_allclose(xyz, estimate.T[:, :3, 3], atol=1e-6)
    pieces = [row.value[0] for row in rows(drawn / "out.rrd", "/odom/path", "LineStrips3D:strips")]
    np.testing.assert_allclose([piece[1] for piece in pieces], estimate.T[:, :3, 3], atol=1e-6)
    np.testing.assert_allclose([piece[0] for piece in pieces[1:]], [piece[1] for piece in pieces[:-1]], atol=0)
    assert verified(drawn / "out.rrd")


def test_every_pair_has_an_image_with_features_and_depth(drawn: Path) -> None:
    images = rows(drawn / "out.rrd", "/panorama", "EncodedImage:blob")
    depths = rows(drawn / "out.rrd", "/depth", "EncodedDepthImage:blob")
    inliers = rows(drawn / "out.rrd", "/panorama/inliers", "Points2D:positions")
    found = rows(drawn / "out.rrd", "/landmarks/inliers", "Scalars:scalars")
    assert len(images) == len(depths) == len(inliers) == len(found) == PAIRS
    image = cv2.imdecode(np.array(images[0].value[0], np.uint8), cv2.IMREAD_UNCHANGED)
    depth = cv2.imdecode(np.array(depths[0].value[0], np.uint8), cv2.IMREAD_UNCHANGED)
    assert image.shape == depth.shape and depth.dtype == np.uint16
    assert 300 < np.median(depth[depth > 0]) < 4000  # mm, of a corridor
    assert all(len(dots.value) >= count.value[0] for dots, count in zip(inliers[1:], found[1:], strict=True))
    assert len(rows(drawn / "out.rrd", "/panorama/new", "LineStrips2D:strips")[0].value) > 50


def test_draws_map_ellipsoid_and_plots(drawn: Path) -> None:
    clouds = rows(drawn / "out.rrd", "/odom/map", "Points3D:positions")
    assert len(clouds[-1].value) > 500 and np.abs(np.array(clouds[-1].value)).max() < 20
    assert len(rows(drawn / "out.rrd", "/odom/covariance", "Ellipsoids3D:half_sizes")) == PAIRS
    speed = [row.value[0] for row in rows(drawn / "out.rrd", "/speed/m\\/s", "Scalars:scalars")]
    assert len(speed) == PAIRS and 0.2 < np.median(speed) < 1.0
    odometry_ms = [row.value[0] for row in rows(drawn / "out.rrd", "/latency/odometry", "Scalars:scalars")]
    assert odometry_ms and min(odometry_ms) > 0
    assert {"/legend", "/state", "/log", "/sigma/position\\ mm"} <= entities(drawn / "out.rrd")


def test_draws_keyframes_and_loops_of_the_map(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A drive there and back closes loops; keyframes lie on the path, where nothing corrects it much."""
    need_rerun()
    run = build("there_and_back", seed=3, size=256)
    write_log(tmp_path, run.rig, run.poses, run.scene, sensor=run.sensor, seed=3)
    omnid, drawn = Command(capsys), tmp_path / "out.rrd"
    assert omnid("view", tmp_path / "log.mcap", "--rig", tmp_path / "rig.toml", "--quiet", "-o", drawn).code == 0
    keyframes = np.array(rows(drawn, "/odom/keyframes", "Points3D:positions")[-1].value)
    loops = rows(drawn, "/odom/loops", "LineStrips3D:strips")
    _, path = positions(drawn)
    apart = np.linalg.norm(keyframes[:, None] - path[None], axis=2).min(axis=1)
    assert len(keyframes) >= 5 and apart.max() < 0.05
    assert len(loops[0].value or []) == 0 and len(loops[-1].value) >= 3
    corrections = [row.value[0] for row in rows(drawn, "/correction/position\\ mm", "Scalars:scalars")]
    assert len(corrections) == len(path) and corrections[0] == 0 and 0 < corrections[-1] < 50


def test_shows_a_recording(drawn: Path, omnid: Command) -> None:
    code, out, _ = omnid("view", drawn / "rec.mcap", "-o", drawn / "rec.rrd")
    assert code == 0 and out.startswith(f"{PAIRS} poses and 0 images shown\n")
    for ours, recorded in zip(positions(drawn / "out.rrd"), positions(drawn / "rec.rrd"), strict=True):
        np.testing.assert_allclose(ours, recorded, atol=1e-6)
    clouds = [rows(drawn / name, "/odom/map", "Points3D:positions")[-1].value for name in ("out.rrd", "rec.rrd")]
    np.testing.assert_allclose(clouds[0], clouds[1], atol=1e-6)
    assert [row.value for row in rows(drawn / "rec.rrd", "/state", "StateChange:state")] == [["tracking"]]
    assert "/panorama" not in entities(drawn / "rec.rrd") and verified(drawn / "rec.rrd")


def test_a_recording_without_images_cannot_be_replayed(drawn: Path, omnid: Command) -> None:
    error = omnid.refused("view", drawn / "rec.mcap", "--replay", "-o", drawn / "not.rrd")
    assert "no image topics" in error and not (drawn / "not.rrd").exists()


def made(path: Path, robots: tuple[str, ...] = ("rover",)) -> Path:
    """Write a recording with three poses, two states, an image and a damaged message per robot."""
    writer = LogWriter(path, {})
    for robot in robots:
        for number, state in enumerate(("tracking", "tracking", "lost")):
            stamp_ns, T = START_NS + number * 10**8, se3.transform(np.eye(3), [0.1 * number, 0.0, 0.0])
            writer.write(
                f"/{robot}/odom",
                codec.ODOMETRY_SCHEMA,
                codec.odometry_cdr(stamp_ns, T, 1e-4 * np.eye(6), np.zeros(6), np.eye(6)),
                stamp_ns,
            )
            statuses = [DiagnosticStatus(ODOMETRY, 0, state, {"inliers": str(number), "tracked": "9"})]
            payload = codec.diagnostics_cdr(stamp_ns, statuses)
            writer.write(f"/{robot}/status", codec.DIAGNOSTICS_SCHEMA, payload, stamp_ns)
        writer.write(f"/{robot}/odom", codec.ODOMETRY_SCHEMA, b"nonsense", START_NS + 10**9)
        raw = Frame(0, START_NS, "lower", "mono8", np.full((8, 16), 50, np.uint8), 16, 8)
        writer.write(f"/{robot}/lower/image_raw", *image_cdr(raw, START_NS), START_NS)
    writer.close()
    return path


def test_poses_have_the_state_recorded_after_them(tmp_path: Path, omnid: Command) -> None:
    need_rerun()
    code, out, err = omnid("view", made(tmp_path / "made.mcap"), "-o", tmp_path / "made.rrd")
    assert code == 0 and out.startswith("3 poses and 1 images shown") and "1 messages" in err
    states = rows(tmp_path / "made.rrd", "/state", "StateChange:state")
    assert [row.value[0] for row in states] == ["tracking", "lost"] and states[1].stamp_ns == START_NS + 2 * 10**8
    widths = [-row.value[0] for row in rows(tmp_path / "made.rrd", "/odom/path", "LineStrips3D:radii")]
    assert widths[0] == widths[1] < widths[2]  # negative: in pixels of the screen
    found = [row.value[0] for row in rows(tmp_path / "made.rrd", "/landmarks/inliers", "Scalars:scalars")]
    assert found == [0, 1, 2]
    image = rows(tmp_path / "made.rrd", "/panorama", "EncodedImage:blob")[0].value[0]
    assert cv2.imdecode(np.array(image, np.uint8), cv2.IMREAD_UNCHANGED).shape == (8, 16)


def test_shows_one_of_several_robots(tmp_path: Path, omnid: Command) -> None:
    need_rerun()
    log, out = made(tmp_path / "two.mcap", ("rover", "digger")), tmp_path / "two.rrd"
    error = omnid.refused("view", log, "-o", out)
    assert "/rover/odom" in error and "/digger/odom" in error and "--topic" in error
    assert "'/crane/odom'" in omnid.refused("view", log, "-o", out, "--robot", "crane") and not out.exists()
    assert omnid("view", log, "-o", out, "--robot", "digger").out.startswith("3 poses")


def test_without_rerun_the_installation_is_named(scene: Path, omnid: Command, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "rerun", None)
    assert f"{sys.executable} -m pip install 'rerun-sdk" in omnid.refused("view", scene / "log.mcap", "-o", "x.rrd")
