"""A drive there and back with a rig that is slightly wrong: the trajectory in the map is better, and published."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader

from calib import se3
from calib.rig_file import read_rig, write_rig
from omnid.config import load_config
from omnid.core.mapping.scan_grid import FREE, OCCUPIED
from omnid.formats.tum import read_tum
from omnid.recordings.evaluation import evaluate
from omnid.runs.replay import ReplayOptions, run_log
from omnid.tracking_state import MapState
from omnid.transport.codec import decode_diagnostics
from omnid.transport.status_names import PLACES
from tests.drivers.logs.mcap_logs import STORE
from tests.replay.command import Command
from tests.simulation import build, write_log
from tests.simulation.rigs import with_upper_rotated


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with log.mcap, truth.txt and a rig whose upper camera is rotated by 0.3 degrees."""
    folder = tmp_path_factory.mktemp("drive")
    run = build("there_and_back", seed=3, size=256)
    write_log(folder, run.rig, run.poses, run.scene, sensor=run.sensor, seed=3)
    write_rig(folder / "wrong.toml", with_upper_rotated(read_rig(folder / "rig.toml"), (0.2, -0.2, 0.1)))
    return folder


def test_the_trajectory_in_the_map_is_better_and_the_same_threaded_and_inline(
    omnid: Command, tmp_path: Path, drive: Path
) -> None:
    for name, more in (("a", ["--record", tmp_path / "out.mcap"]), ("b", ["--inline"])):
        files = ("--tum", tmp_path / f"{name}.odom", "--map-tum", tmp_path / name, *more)
        files = (*files, "--map-live-tum", tmp_path / f"{name}.live")
        result = omnid.replay(drive / "log.mcap", *files, "--set", "rig.check=off", rig=drive / "wrong.toml")
        assert result.code == 0 and result.count("loops") >= 3
    for end in ("", ".live"):
        assert (tmp_path / f"a{end}").read_bytes() == (tmp_path / f"b{end}").read_bytes()
    odom, in_map, truth = (read_tum(path) for path in (tmp_path / "a.odom", tmp_path / "a", drive / "truth.txt"))
    assert np.array_equal(odom.stamps_ns, in_map.stamps_ns)
    by_odometry, by_map = evaluate(odom, truth), evaluate(in_map, truth)
    assert by_odometry.end_error_m > 0.01 and by_map.end_error_m < 0.6 * by_odometry.end_error_m
    _assert_published(tmp_path / "out.mcap", odom.T)
    # What the controller had: odometry's poses until the first place was recognised, corrected ones afterwards.
    live = read_tum(tmp_path / "a.live")
    np.testing.assert_allclose(live.T[:5], odom.T[:5], atol=1e-6)
    words = ("eval", tmp_path / "a", drive / "truth.txt", "--live", tmp_path / "a.live")
    found = json.loads(omnid(*words, "--json").out)
    assert found["end_error_m"] == pytest.approx(by_map.end_error_m)
    assert found["ate_rmse_m"] < found["live"]["ate_rmse_m"] and found["live"]["end_error_m"] < by_odometry.end_error_m
    assert "as known while driving" in omnid(*words).out


def _assert_published(log: Path, T_odom_rig: np.ndarray) -> None:
    """Check map -> odom, the pose in the map and its state in a recording; the base is the rig."""
    with log.open("rb") as file:
        reader = make_reader(file)
        found: dict[str, list] = {"/tf": [], "/omnid/map_pose": [], "/omnid/status": [], "/omnid/map": []}
        for schema, channel, message in reader.iter_messages(list(found)):
            found[channel.topic].append(
                STORE.deserialize_cdr(message.data, schema.name)
                if channel.topic != "/omnid/status"
                else decode_diagnostics(message.data)
            )
    edges = [edge for message in found["/tf"] for edge in message.transforms if edge.header.frame_id == "map"]
    assert {edge.child_frame_id for edge in edges} == {"odom"} and len(edges) == len(T_odom_rig)
    for edge, pose, T in zip(edges, found["/omnid/map_pose"], T_odom_rig, strict=True):
        t, q, p = edge.transform.translation, edge.transform.rotation, pose.pose.pose.position
        T_map_odom = se3.transform(se3.rotation((q.x, q.y, q.z, q.w)), (t.x, t.y, t.z))
        np.testing.assert_allclose((p.x, p.y, p.z), (T_map_odom @ T)[:3, 3], atol=1e-6)
        assert pose.header.frame_id == "map" and pose.pose.covariance[0] >= 0
    first, last = edges[0].transform.translation, edges[-1].transform.translation
    assert (first.x, first.y, first.z) == (0, 0, 0) and abs(last.x) + abs(last.y) > 0.005
    states = [
        status.values["state"]
        for statuses in found["/omnid/status"]
        for status in statuses.statuses
        if status.name == PLACES
    ]
    assert states == ["odometry only", "localized"]
    # The map is that of the keyframes, in their frame: it moves when a loop closes.
    [grid] = found["/omnid/map"]
    assert grid.header.frame_id == "map" and {FREE, OCCUPIED} <= set(grid.data.tolist())


def test_a_run_begins_in_a_known_map(scene: Path, elsewhere: Path, tmp_path: Path) -> None:
    """It localises within a second, in another world it does not; localize_only leaves the map as it was."""
    options, words = ReplayOptions(rig=scene / "rig.toml", collect=True), [f"places.map='{tmp_path / 'a.omap'}'"]
    first = run_log(scene / "log.mcap", load_config(None, words), options)
    assert first.places is not None and len(first.places) >= 3
    poses = {id: pose.copy() for id, pose in first.places.poses.items()}
    for log, known in ((scene, True), (elsewhere, False)):
        result = run_log(log / "log.mcap", load_config(None, [*words, "places.localize_only=true"]), options)
        assert (MapState.LOCALIZED in result.map_states[:10]) == known
        assert result.places is not None and result.places.poses.keys() >= poses.keys()
        assert all(np.allclose(result.places.poses[id], pose, atol=1e-9) for id, pose in poses.items())
        if known:
            errors = se3.log(se3.inverse(first.T_odom_rig[10:]) @ result.T_map_rig[10:])
            assert np.abs(errors[:, :3]).max() < 0.01 and np.abs(errors[:, 3:]).max() < 0.005
        else:
            assert set(result.map_states) == {MapState.ODOMETRY_ONLY}


def test_without_places_there_is_no_trajectory_in_the_map(omnid: Command, tmp_path: Path, scene: Path) -> None:
    error = omnid.refused(
        "replay",
        scene / "log.mcap",
        "--rig",
        scene / "rig.toml",
        "--quiet",
        "--map-tum",
        tmp_path / "map.txt",
        "--set",
        "places.enabled=false",
    )
    assert "places.enabled" in error
