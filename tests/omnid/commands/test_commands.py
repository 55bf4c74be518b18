"""`omnid config`, `replay --json`, `log info`, `record` and `map show|export` as commands."""

from __future__ import annotations

import json
import re
import subprocess
import sys
from contextlib import closing
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from drivers.logs.log_reader import LogReader
from omnid.config import Config, load_config
from omnid.formats.place_file import write_places
from tests.drivers.logs.mcap_logs import LOWER, START_NS, Entry, pairs, text, write_log
from tests.omnid.formats.place_maps import RIG, some_places
from tests.ply import read_ply
from tests.replay.command import Command


def test_a_minimal_file_has_what_a_robot_needs_and_changes_nothing(omnid: Command, tmp_path: Path) -> None:
    file = tmp_path / "omnid.toml"
    file.write_text(omnid("config", "--minimal").out)
    assert load_config(file) == Config()
    text = file.read_text()
    assert "# lower = " in text and "[motor.drive]" in text and len(text.splitlines()) < 120
    changed = omnid("config", "--minimal", "--set", "bus.robot=rover", "--set", "stereo.min_range_m=0.7").out
    file.write_text(changed)
    assert load_config(file) == load_config(None, ["bus.robot=rover", "stereo.min_range_m=0.7"])
    assert '\nrobot = "rover"\n' in changed


def test_a_profile_is_a_set_of_settings_and_gives_way_to_set(omnid: Command, tmp_path: Path) -> None:
    file = tmp_path / "omnid.toml"
    for words, scale in ((["--profile", "small"], 0.5), (["--set", "panorama.scale=0.7", "--profile", "small"], 0.7)):
        file.write_text(omnid("config", "--minimal", *words).out)
        config = load_config(file)
        assert (config.panorama.scale, config.odometry.limits.features) == (scale, 250)


def test_check_names_what_is_wrong(omnid: Command, tmp_path: Path) -> None:
    file = tmp_path / "omnid.toml"
    file.write_text("[bus]\nrobot = 'rover'\n")
    assert omnid("config", "check", file).out == f"{file}: good\n"
    file.write_text("[bus]\nrobots = 'rover'\n")
    assert "known are bus.robot, " in omnid.refused("config", "check", file)
    file.write_text("[motor]\nprotocol = 'waveshare_json'\n")
    assert "expected one of line, roboteq" in omnid.refused("config", "check", file)
    assert "expected one of line, roboteq" in omnid.refused("motor", "test", "--motor", "simulated", "--config", file)
    file.write_text("[bus]\nrobot = 'a/*'\n")
    assert "bus.robot is 'a/*'" in omnid.refused("config", "check", file)
    assert omnid("route", "list", "--set", f"navigation.routes={tmp_path}").out.startswith(f"no routes in {tmp_path} ")


FEW = 8  # pairs of a replay of 0.75 s


def loaded(omnid: Command, *words: object, code: int = 0) -> Any:
    done = omnid(*words, "--json")
    assert done.code == code, done.err
    return json.loads(done.out)


def test_the_results_of_a_replay_are_written_as_json(omnid: Command, scene: Path, tmp_path: Path) -> None:
    tum = tmp_path / "est.txt"
    words = ("replay", scene / "log.mcap", "--rig", scene / "rig.toml", "--quiet", "--inline", "--seconds", 0.75)
    first = loaded(omnid, *words, "--tum", tum)
    assert first["counters"]["poses"] == FEW and first["counters"]["states"]["tracking"] == FEW
    assert first["timings"]["odometry"]["n"] == FEW and first["signal"] == 0
    assert 0 < first["elapsed_s"] < 600
    metrics = loaded(omnid, "eval", tum, scene / "truth.txt")
    assert metrics["pairs"] == FEW and 0 < metrics["ate_rmse_m"] < 0.05


pytestmark = pytest.mark.usefixtures("default_signals")

ROOT = Path(__file__).parents[3]
RECORDS = """
import os
import sys
import time
from dataclasses import replace
from pathlib import Path
from drivers.cameras.log_camera import LogCamera, LogPlayback
from omnid.config import Config
from omnid.runs.live import record_frames

log, rig, folder = map(Path, sys.argv[1:])
config = Config()
config = replace(config, record=replace(config.record, folder=str(folder), free_mb=0, file_mb=100))
playback = LogPlayback(log, pace=3.0)

class Camera(LogCamera):
    def frames(self):
        for frame in super().frames():
            line = f"{frame.camera} {frame.stamp_ns + time.time_ns() - time.monotonic_ns()}\\n"
            os.write(1, line.encode())  # one write, so that the lines of both threads do not mix
            yield frame

cameras = {name: Camera(playback, name) for name in ("lower", "upper")}
record_frames(cameras, config, rig.read_text())
"""


def recording(scene: Path, folder: Path) -> subprocess.Popen[str]:
    """Start a program that records the scene at 30 images a second of each camera, and prints their stamps."""
    command = [sys.executable, "-c", RECORDS, str(scene / "log.mcap"), str(scene / "rig.toml"), str(folder)]
    return subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True)


def printed(process: subprocess.Popen[str], count: int) -> list[int]:
    assert process.stdout is not None
    return [int(process.stdout.readline().split()[1]) for _ in range(count)]


def test_a_kill_costs_at_most_a_second_and_the_rest_is_read(tmp_path: Path, scene: Path, omnid: Command) -> None:
    folder = tmp_path / "log"
    with recording(scene, folder) as process:
        stamps = printed(process, 150)  # 2.5 s
        process.kill()
        assert process.stdout is not None
        stamps += [int(line.split()[1]) for line in process.stdout if line.endswith("\n")]
    (part,) = folder.iterdir()
    assert omnid("log", "info", part).code == 1
    with closing(LogReader(part)) as reader:
        times = [frame.stamp_ns for frame in reader.frames()]
    # The writer syncs once a second; on a busy computer the sync itself may take most of another one.
    assert max(stamps) - max(times) < 2 * 10**9
    shortly_before_ns = max(times) - 216_000_000  # the order of simultaneous images of both cameras is arbitrary
    assert sum(stamp < shortly_before_ns for stamp in times) == sum(stamp < shortly_before_ns for stamp in stamps)
    replayed = omnid.replay(part, "--inline")
    assert replayed.code == 0, replayed.err
    # Images whose partner was dropped on a busy machine, and those at which the log turns back: they come twice.
    alone = sum(
        replayed.count(f"{reason}_{camera}") for reason in ("unpaired", "repeated") for camera in ("lower", "upper")
    )
    assert 2 * replayed.count("pairs") + alone == len(times) and replayed.count("poses") == replayed.count("pairs") > 50


def test_info_shows_the_content_of_a_log(omnid: Command, tmp_path: Path) -> None:
    noise = [Entry("/chatter", "std_msgs/msg/String", text("hello"), START_NS)]
    path = write_log(tmp_path / "log.mcap", [*pairs(11), *noise], [("rig.toml", bytes(2000))])
    code, out, err = omnid("log", "info", path)
    assert (code, err) == (0, "")
    assert re.search(r"state +whole\n", out) and re.search(r"messages +23\n", out)
    assert "2023-11-14T22:13:20.000Z to 2023-11-14T22:13:21.001Z, 1.001 s" in out
    assert "rig.toml (2.0 kB)" in out
    assert re.search(rf"{LOWER} +sensor_msgs/msg/CompressedImage +11 +10.00\n", out)
    assert re.search(r"/chatter +std_msgs/msg/String +1 +-\n", out)


@pytest.fixture
def omap(tmp_path: Path) -> Path:
    """Write a map of 12 keyframes."""
    write_places(tmp_path / "a.omap", some_places(12, features=20), RIG)
    return tmp_path / "a.omap"


def test_show_prints_the_sizes(omap: Path, omnid: Command) -> None:
    printed = omnid("map", "show", omap).out
    for line in (
        "sessions     2",
        "keyframes    12; 3 were dropped",
        "loops        1",
        "path         3.3 m",
        "rig          0123abcd0123, baseline 0.2400 m, panoramas of 1304 x 378 px",
    ):
        assert line in printed


def test_export_writes_the_files_and_names_them(omap: Path, omnid: Command) -> None:
    a = {end: omap.parent / f"a.{end}" for end in ("ply", "png", "yaml", "pgm")}
    words = ("--ply", a["ply"], "--plan", a["png"], "--grid", a["yaml"], "--cell", 0.1)
    printed = omnid("map", "export", omap, *words).out
    assert all(str(path) in printed for path in a.values())
    assert len(read_ply(a["ply"]).xyz) > 50 and a["pgm"].read_bytes().startswith(b"P5\n")
    assert "resolution: 0.1\n" in a["yaml"].read_text() and 'image: "a.pgm"\n' in a["yaml"].read_text()
    # The loop is a line of its own colour in the plan.
    plan = cv2.imread(str(a["png"])).astype(int)
    assert np.count_nonzero(plan[..., 0] > plan[..., 2] + 100) > 20


def test_mistakes_are_one_line(omap: Path, omnid: Command) -> None:
    before = omap.read_bytes()
    assert "nothing to write" in omnid.refused("map", "export", omap)
    assert "expected a name that ends in .yaml" in omnid.refused("map", "export", omap, "--grid", f"{omap}.png")
    assert "cannot read the map" in omnid.refused("map", "show", f"{omap}.none")
    assert omap.read_bytes() == before and [path.name for path in omap.parent.iterdir()] == ["a.omap"]
