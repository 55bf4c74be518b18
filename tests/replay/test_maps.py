"""Maps of places by the command line: built from logs, extended also by live runs, left as they are, refused."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader

from calib import se3
from calib.rig_file import read_rig, write_rig
from omnid.api import replay
from omnid.client import Robot
from omnid.formats.place_file import read_places, write_places
from omnid.formats.tum import read_tum
from omnid.runs.run_result import RunFailedError
from omnid.tracking_state import MapState
from omnid.transport.status_names import Key
from tests.conftest import PAIRS
from tests.ports import free_port
from tests.replay.command import Command
from tests.replay.live import Daemon, Operator, answers, command_line, started
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


@pytest.fixture
def omap(built: Path, tmp_path: Path) -> Path:
    """A copy of it."""
    (tmp_path / "place.omap").write_bytes(built.read_bytes())
    return tmp_path / "place.omap"


def test_a_map_without_the_height_of_the_cameras_warns_and_has_no_free_cell(
    omnid: Command, omap: Path, tmp_path: Path
) -> None:
    places, rig = read_places(omap)
    for number, expected in enumerate((True, False)):
        result = omnid("map", "export", omap, "--grid", tmp_path / f"{number}.yaml")
        assert result.code == 0 and (b"\xfe" in (tmp_path / f"{number}.pgm").read_bytes()) == expected
        assert ("warning" not in result.err) == expected and ("no cell is free" in result.err) != expected
        for keyframe in places.keyframes.values():
            keyframe.free_m.fill(0)
        write_places(omap, places, rig)


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


def test_a_map_that_does_not_exist_is_made(omnid: Command, scene: Path, built: Path, tmp_path: Path) -> None:
    new = tmp_path / "new.omap"
    result = omnid.replay(scene / "log.mcap", "--map", new, rig=scene / "rig.toml")
    assert result.code == 0 and f"{new}: there is no such map: this run begins a new one" in result.err
    assert new.read_bytes() == built.read_bytes()


def test_localize_only_leaves_the_map_as_it_is_and_a_rig_that_was_calibrated_again_warns(
    omnid: Command, scene: Path, omap: Path, tmp_path: Path
) -> None:
    write_rig(tmp_path / "better.toml", with_upper_rotated(read_rig(scene / "rig.toml"), (0.02, 0.0, 0.0)))
    before = omap.read_bytes()
    result = omnid.replay(scene / "log.mcap", "--map", omap, "--localize-only", rig=tmp_path / "better.toml")
    assert result.code == 0 and result.count("loops") >= 2
    assert "calibrated again" in result.err and omap.read_bytes() == before and "written" not in result.out


def test_what_is_not_recognised_is_left_out_with_a_warning(
    omnid: Command, scene: Path, elsewhere: Path, omap: Path, tmp_path: Path
) -> None:
    """No pose in the map is written, and no transform from it, as neither could say that the robot may be anywhere."""
    before, log = omap.read_bytes(), tmp_path / "out.mcap"
    files = ("--map-tum", tmp_path / "m", "--map-live-tum", tmp_path / "l", "--record", log)
    for path in (tmp_path / "m", tmp_path / "l"):
        path.write_text("1 0 0 0 0 0 0 1")  # of an earlier run
    result = omnid.replay(elsewhere / "log.mcap", "--map", omap, *files, rig=scene / "rig.toml")
    assert result.code == 0 and result.count("loops") == 0
    assert f"{omap}: no place of it was recognised" in result.err and omap.read_bytes() == before
    assert not (tmp_path / "m").read_bytes() and not (tmp_path / "l").read_bytes()
    assert result.err.count("poses are left out") == 2
    with log.open("rb") as file:
        topics = [channel.topic for _, channel, message in make_reader(file).iter_messages() if b"map" in message.data]
    assert "/omnid/map_pose" in topics and "/tf" not in topics and "/omnid/map" not in topics


def test_build_extends_a_map(omnid: Command, scene: Path, omap: Path) -> None:
    before = len(read_places(omap)[0])
    result = omnid("map", "build", scene / "log.mcap", "-o", omap, "--extend", "--rig", scene / "rig.toml", "--quiet")
    assert result.code == 0 and f"keyframes    {2 * before}, " in result.out and "sessions     2" in result.out


def test_the_map_of_another_rig_is_refused(omnid: Command, scene: Path, omap: Path) -> None:
    error = omnid.refused(
        "replay",
        scene / "log.mcap",
        "--rig",
        scene / "rig.toml",
        "--quiet",
        "--map",
        omap,
        "--set",
        "panorama.width_px=400",
    )
    assert "panoramas of 432 columns, not 400" in error


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--map", "{}/none.omap", "--localize-only"], "cannot read the map"),
        (["--map", "{}/none/a.omap"], "there is no folder"),
        (["--map", "{}/a.ply"], "--cloud FILE.ply"),
        (["--map", "{}/log.mcap"], "expected a map of places"),
        (["--localize-only"], "needs a map"),
        (["--map", "{}/none.omap", "--set", "places.enabled=false"], "places.enabled = true"),
    ],
)
def test_wrong_maps_are_one_line(omnid: Command, scene: Path, words: list[str], message: str) -> None:
    given = [word.format(scene) for word in words]
    assert message in omnid.refused("replay", scene / "log.mcap", "--rig", scene / "rig.toml", "--quiet", *given)


def test_build_refuses_what_it_cannot_do(omnid: Command, scene: Path, tmp_path: Path) -> None:
    build = ("map", "build", scene / "log.mcap", "--rig", scene / "rig.toml", "--quiet", "-o")
    assert "there is no folder" in omnid.refused(*build, tmp_path / "none" / "a.omap")
    assert "this is the log" in omnid.refused(*build, scene / "log.mcap")
    assert "cannot read the map" in omnid.refused(*build, tmp_path / "a.omap", "--extend")
    assert "places.enabled" in omnid.refused(*build, tmp_path / "a.omap", "--set", "places.enabled=false")


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


def test_a_replay_whose_map_cannot_be_written_keeps_its_poses(scene: Path, tmp_path: Path) -> None:
    """The folder of the map is removed while the log is replayed."""
    folder = tmp_path / "maps"
    folder.mkdir()

    def progress(done: int, expected: int | None) -> None:
        if done and folder.exists():
            folder.rmdir()

    settings = [f"places.map={folder / 'm.omap'}"]
    with pytest.raises(RunFailedError, match="cannot write the map") as failed:
        replay(scene / "log.mcap", scene / "rig.toml", overrides=settings, progress=progress)
    assert len(failed.value.result.stamps_ns) == PAIRS


@pytest.mark.parametrize("exists", [True, False])
def test_a_map_that_another_program_has_written_meanwhile_is_not_replaced(
    scene: Path, built: Path, tmp_path: Path, exists: bool
) -> None:
    """Two replays extend one map: the last one does not win."""
    omap, moved = tmp_path / "place.omap", tmp_path / "moved.omap"
    places, rig = read_places(built)
    places.poses.update({id: se3.transform(np.eye(3), [100.0, 50.0, 0.0]) @ T for id, T in places.poses.items()})
    write_places(moved, places, rig)
    if exists:
        omap.write_bytes(built.read_bytes())

    def progress(done: int, expected: int | None) -> None:
        if done and moved.exists():
            moved.rename(omap)

    result = replay(scene / "log.mcap", scene / "rig.toml", overrides=[f"places.map={omap}"], progress=progress)
    assert result.map_file == tmp_path / "place-2.omap"
    assert any("another program has written this map" in warning for warning in result.warnings)
    for path, x_m in ((omap, 100.0), (tmp_path / "place-2.omap", 0.0)):
        assert abs(min(T[0, 3] for T in read_places(path)[0].poses.values()) - x_m) < 5.0


@pytest.mark.slow
@pytest.mark.usefixtures("default_signals")
def test_a_map_that_cannot_be_saved_is_an_error_in_the_status(scene: Path, omap: Path) -> None:
    """Its place is taken by a folder; the run goes on, and its exit code is that of the failed save at the end."""
    with running(scene, omap) as (daemon, operator):
        omap.unlink()
        (omap / "taken").mkdir(parents=True)
        wait_until(lambda: "cannot write the map" in operator.message("map file"), "the error")
        assert int(operator.values("map file")["failed"]) >= 1 and daemon.alive
        code, err = daemon.end()
        assert code == 2 and "cannot write the map" in err and "Traceback" not in err, err
