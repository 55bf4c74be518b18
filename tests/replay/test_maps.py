"""Maps of places: built, used again, shown and exported by commands, and the pose in them."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader

from calib import se3
from calib.rig_file import read_rig, write_rig
from omnid.client import Robot
from omnid.core.mapping.scan_grid import FREE, OCCUPIED
from omnid.formats.place_file import read_places
from omnid.formats.tum import read_tum
from omnid.recordings.evaluation import evaluate
from omnid.tracking_state import MapState
from omnid.transport.codec import decode_diagnostics
from omnid.transport.status_names import PLACES, Key
from tests.drivers.logs.mcap_logs import STORE
from tests.ports import free_port
from tests.replay.command import Command, recorded
from tests.replay.live import Daemon, Operator, answers, command_line, started
from tests.simulation import build, write_log
from tests.simulation.rigs import with_upper_rotated
from tests.waiting import wait_until


@pytest.fixture(scope="module")
def built(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The map of the scene's log."""
    from omnid.cli import main

    path = tmp_path_factory.mktemp("map") / "scene.omap"
    assert (
        main(["map", "build", str(scene / "log.mcap"), "-o", str(path), "--rig", str(scene / "rig.toml"), "--quiet"])
        == 0
    )
    return path


UNCHECKED = ("--set", "rig.check=off", "--set", "obstacles.scan.floor_m=-1.2")  # the base frame is the rig's


@pytest.fixture
def omap(built: Path, tmp_path: Path) -> Path:
    """A copy of it."""
    (tmp_path / "place.omap").write_bytes(built.read_bytes())
    return tmp_path / "place.omap"


def test_a_second_run_is_localised_from_its_first_second_and_extends_the_map(
    omnid: Command, scene: Path, omap: Path, tmp_path: Path
) -> None:
    """Threaded and inline with the same bytes."""
    before, twin = len(read_places(omap)[0]), tmp_path / "twin.omap"
    twin.write_bytes(omap.read_bytes())
    for path, more in ((omap, ["--map-tum", tmp_path / "m"]), (twin, ["--inline"])):
        result = omnid.replay(scene / "log.mcap", "--map", path, *more, rig=scene / "rig.toml")
        assert result.code == 0 and result.count("loops") >= 2
        assert result.out.splitlines()[-1].startswith("written") and result.out.rstrip().endswith(str(path))
        assert result.err.count("warning") == 1 and "height of the cameras" in result.err  # not stated
    assert omap.read_bytes() == twin.read_bytes()
    places, _ = read_places(omap)
    assert len(places) == 2 * before and {k.session for k in places.keyframes.values()} == {0, 1}
    in_map, truth = read_tum(tmp_path / "m"), read_tum(scene / "truth.txt")
    T = np.linalg.inv(truth.T[0]) @ truth.T[-1]
    np.testing.assert_allclose(in_map.T[-1][:3, 3], T[:3, 3], atol=0.02)


def test_localize_only_leaves_the_map_as_it_is_and_a_rig_that_was_calibrated_again_warns(
    omnid: Command, scene: Path, omap: Path, tmp_path: Path
) -> None:
    write_rig(tmp_path / "better.toml", with_upper_rotated(read_rig(scene / "rig.toml"), (0.02, 0.0, 0.0)))
    before = omap.read_bytes()
    result = omnid.replay(scene / "log.mcap", "--map", omap, "--localize-only", rig=tmp_path / "better.toml")
    assert result.code == 0 and result.count("loops") >= 2
    assert "calibrated again" in result.err and omap.read_bytes() == before and "written" not in result.out


def test_logs_that_are_not_recognised_are_left_out_with_a_warning(
    omnid: Command, scene: Path, elsewhere: Path, omap: Path, tmp_path: Path
) -> None:
    """No pose in the map is written, and no transform from it, as neither could say that the robot may be anywhere."""
    before, log = omap.read_bytes(), tmp_path / "out.mcap"
    files = ("--map-tum", tmp_path / "m", "--record", log)
    (tmp_path / "m").write_text("1 0 0 0 0 0 0 1")  # of an earlier run
    result = omnid.replay(elsewhere / "log.mcap", "--map", omap, *files, rig=scene / "rig.toml")
    assert result.code == 0 and result.count("loops") == 0
    assert f"{omap}: no place of it was recognised" in result.err and omap.read_bytes() == before
    assert not (tmp_path / "m").read_bytes()
    assert result.err.count("poses are left out") == 1
    assert recorded(log, "/omnid/map_pose") and not recorded(log, "/omnid/map")
    assert not any(b"map" in message for message in recorded(log, "/tf"))


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--map", "{}/none.omap", "--localize-only"], "cannot read the map"),
        (["--map-tum", "{}/map.txt", "--set", "places.enabled=false"], "places.enabled"),
        (["--localize-only"], "needs a map"),
        (["--map", "{omap}", "--set", "panorama.width_px=400"], "panoramas of 432 columns, not 400"),
    ],
)
def test_wrong_maps_are_one_line(omnid: Command, scene: Path, built: Path, words: list[str], message: str) -> None:
    given = [word.format(scene, omap=built) for word in words]
    assert message in omnid.refused("replay", scene / "log.mcap", "--rig", scene / "rig.toml", "--quiet", *given)


@contextmanager
def running(scene: Path, omap: Path, *words: object) -> Iterator[tuple[Daemon, Operator]]:
    """Yield a daemon on the images of the scene, localised in the map."""
    port = free_port()
    settings = ("--set", "places.save_s=1", "--set", "obstacles.enabled=false")
    command = command_line(scene, port, None, "--map", omap, *settings, *words)
    with started(command, port) as daemon:
        wait_until(lambda: answers(port) or not daemon.alive, "the bus")
        assert daemon.alive, daemon.process.communicate()[1]
        operator = Operator(port)
        try:
            wait_until(lambda: operator.values("places").get(Key.STATE) == MapState.LOCALIZED, "localisation")
            yield daemon, operator
        finally:
            operator.close()


def sessions(omap: Path) -> set[int]:
    return {keyframe.session for keyframe in read_places(omap)[0].keyframes.values()}


@pytest.mark.usefixtures("default_signals")
def test_a_live_run_extends_its_map_now_and_then_and_at_its_end(scene: Path, omap: Path) -> None:
    with running(scene, omap) as (daemon, operator):
        wait_until(lambda: sessions(omap) == {0, 1}, "a save")
        wait_until(lambda: int(operator.values("map file").get("saves", "0")) >= 1, "the status of a save")
        daemon.end(signal.SIGKILL)
    assert sessions(omap) == {0, 1}
    with running(scene, omap, "--set", "places.save_s=1000") as (daemon, operator):
        wait_until(lambda: int(operator.values("places")["loops"]) > 3, "loops")
        assert sessions(omap) == {0, 1}
        with Robot(connect=(f"tcp/127.0.0.1:{daemon.port}",)) as program:
            assert program.driver().save_map() == (True, "the map is saved")
        assert sessions(omap) == {0, 1, 2}
        omap.unlink()  # written again at the end
        code, err = daemon.end()
        assert code == 0 and "Traceback" not in err, err
    assert sessions(omap) == {0, 1, 2}


@pytest.mark.usefixtures("default_signals")
def test_a_live_run_elsewhere_warns_that_no_place_is_recognised(elsewhere: Path, omap: Path) -> None:
    port = free_port()
    with started(command_line(elsewhere, port, None, "--map", omap, "--set", "obstacles.enabled=false"), port):
        wait_until(lambda: answers(port), "the bus")
        with closing(Operator(port)) as operator:
            wait_until(lambda: "where the map was made" in operator.values("places").get(Key.REMEDY, ""), "the warning")


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
        result = omnid.replay(drive / "log.mcap", *files, *UNCHECKED, rig=drive / "wrong.toml")
        assert result.code == 0 and result.count("loops") >= 3
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()
    odom, in_map, truth = (read_tum(path) for path in (tmp_path / "a.odom", tmp_path / "a", drive / "truth.txt"))
    assert np.array_equal(odom.stamps_ns, in_map.stamps_ns)
    by_odometry, by_map = evaluate(odom, truth), evaluate(in_map, truth)
    assert by_odometry.end_error_m > 0.01 and by_map.end_error_m < 0.6 * by_odometry.end_error_m
    _assert_published(tmp_path / "out.mcap", odom.T)


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
