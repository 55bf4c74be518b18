"""`omnid log` and `omnid record` as programs: killed recordings, and any bytes as input."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
from contextlib import closing
from pathlib import Path

import pytest
from mcap.reader import make_reader

from drivers.logs.log_reader import LogReader
from tests.drivers.logs.bags import write_folders
from tests.drivers.logs.mcap_logs import BARE, LOWER, START_NS, Entry, pairs, text, write_log
from tests.replay.command import Command

pytestmark = pytest.mark.usefixtures("default_signals")

ROOT = Path(__file__).parents[3]
RECORDS = """
import os
import sys
import time
from dataclasses import replace
from pathlib import Path
from drivers.cameras.log_camera import LogCamera, LogClock, LogImages
from omnid.config import Config
from omnid.runs.record import record

log, rig, folder = map(Path, sys.argv[1:])
config = Config()
config = replace(config, record=replace(config.record, folder=str(folder), free_mb=0, file_mb=100))
images = LogImages.load(log)
clock = LogClock(time.monotonic_ns())

class Camera(LogCamera):
    def frames(self):
        for frame in super().frames():
            line = f"{frame.camera} {frame.stamp_ns + time.time_ns() - time.monotonic_ns()}\\n"
            os.write(1, line.encode())  # one write, so that the lines of both threads do not mix
            yield frame

cameras = {name: Camera(images, name, clock, pace=3.0) for name in ("lower", "upper")}
record(cameras, config, rig.read_text(), lambda *_: None)
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
    assert part.suffixes == [".mcap", ".part"]
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


def test_a_signal_leaves_a_whole_recording(tmp_path: Path, scene: Path) -> None:
    folder = tmp_path / "log"
    with recording(scene, folder) as process:
        printed(process, 20)
        process.send_signal(signal.SIGTERM)
        rest = process.communicate(timeout=30)[0]
    assert process.returncode == 0
    (path,) = folder.iterdir()
    with path.open("rb") as file:
        count = sum(1 for _ in make_reader(file).iter_messages())
    assert path.suffix == ".mcap" and count == 20 + rest.count("\n")


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


def test_info_shows_the_rate_of_each_topic_over_its_own_time(omnid: Command, tmp_path: Path) -> None:
    """The upper camera was started late. Images without stamps have the rate that is given."""
    entries = [entry for n, entry in enumerate(pairs(40)) if entry.topic == LOWER or n > 60]
    write_folders(tmp_path / "images", entries, names=lambda ns: f"{ns % 10**10:06d}")
    for log, *options in ([write_log(tmp_path / "log.mcap", entries)], [tmp_path / "images", "--rate", "10"]):
        code, out, err = omnid("log", "info", log, *options)
        assert (code, err) == (0 if not options else 1, "")
        assert re.findall(r"CompressedImage +(\d+) +(\S+)\n", out + "\n") == [("40", "10.00"), ("10", "10.00")]


def test_info_shows_the_damage_and_advice(omnid: Command, tmp_path: Path) -> None:
    path = write_log(tmp_path / "log.mcap", pairs(11), [("rig.toml", bytes(2000))])
    bare = write_log(tmp_path / "bare.mcap", pairs(2), **BARE)
    os.truncate(path, path.stat().st_size - 1)
    code, out, _ = omnid("log", "info", bare, path)
    assert code == 1 and f"cut or corrupt after byte {path.read_bytes().index(bytes([15, 4, 0, 0])) + 13}" in out
    assert "rig.toml (2.0 kB)" in out
    code, out, err = omnid("log", "info", tmp_path / "no.mcap", bare)
    assert code == 2 and "No such file" in err and LOWER in out
