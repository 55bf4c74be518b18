"""Replays as processes: stopped by signals, poses over the bus, a full disk."""

from __future__ import annotations

import shutil
import signal
import sys
from pathlib import Path
from typing import Any

import pytest
import zenoh

from tests.conftest import PAIRS
from tests.ply import read_ply
from tests.ports import free_port
from tests.replay.command import recorded, rows
from tests.replay.edited import images, save
from tests.waiting import OMNID, PATIENCE_S, ROOT, running, wait_until

pytestmark = pytest.mark.usefixtures("default_signals")

PAUSE_PAIRS = 36_000  # an hour


def replaying(scene: Path, *words: object) -> list[object]:
    return [*OMNID, "replay", scene / "log.mcap", "--rig", scene / "rig.toml", *words]


@pytest.fixture(scope="module")
def paused(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The scene with a pause of an hour before its last pairs: a replay in real time does not end by itself."""
    folder = tmp_path_factory.mktemp("paused")
    shutil.copy(scene / "rig.toml", folder / "rig.toml")
    save(
        folder / "log.mcap",
        (image.later(PAUSE_PAIRS) if image.pair >= PAIRS - 4 else image for image in images(scene / "log.mcap")),
    )
    return folder


@pytest.mark.parametrize(
    ("number", "code", "manner"),
    [
        (signal.SIGINT, 130, []),
        (signal.SIGTERM, 143, []),
        (signal.SIGHUP, 129, ["--inline"]),
    ],
)
def test_signals_leave_whole_results(tmp_path: Path, paused: Path, number: int, code: int, manner: list[str]) -> None:
    tum, ply, log = tmp_path / "est.txt", tmp_path / "map.ply", tmp_path / "out.mcap"
    command = replaying(paused, "--realtime", "--tum", tum, "--cloud", ply, "--record", log, "--verbose", *manner)
    with running(command) as process:
        wait_until(lambda: tum.exists() and tum.read_bytes().count(b"\n") >= 3)
        process.send_signal(number)
        out, err = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == code, err
    assert "Traceback" not in err and "poses" in out
    written = len(rows(tum))
    assert 3 <= written < PAIRS and len(read_ply(ply).xyz) > 0
    assert len(recorded(log, "/omnid/odom")) == written


def test_the_ten_lines_of_the_document_hear_a_robot_without_omnid(scene: Path) -> None:
    """docs/bus.md begins with a program of zenoh and rosbags alone; only its endpoint is changed here."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    lines = (ROOT / "docs/bus.md").read_text("utf-8").split("```python\n")[1].split("```")[0]
    assert "tcp/127.0.0.1:7447" in lines and "omnid." not in lines
    program = [sys.executable, "-u", "-c", lines.replace("tcp/127.0.0.1:7447", endpoint)]
    config = zenoh.Config()
    for key, value in (
        ("mode", '"router"'),
        ("listen/endpoints", f'["{endpoint}"]'),
        ("scouting/multicast/enabled", "false"),
    ):
        config.insert_json5(key, value)
    sets = ("--set", "bus.listen=[]", "--set", f'bus.connect=["{endpoint}"]')
    with zenoh.open(config) as session, running(program) as hears:
        publisher: Any = session.declare_publisher("omnid/odom")  # zenoh's stub takes its status for a bool
        wait_until(lambda: publisher.matching_status.matching)
        with running(replaying(scene, "--publish", "--quiet", *sets)) as process:
            assert hears.stdout is not None
            assert "Point(x=" in hears.stdout.readline()
            assert process.wait(PATIENCE_S) == 0


def test_a_full_disk_leaves_whole_rows(tmp_path: Path, scene: Path) -> None:
    """A limit on the size of files acts as the disk: Python ignores its signal and gets the error.

    Compiled modules are not written: they would be cut, too.
    """
    tum = tmp_path / "est.txt"
    limited = ["prlimit", "--fsize=1000", *replaying(scene, "--quiet", "--tum", tum)]
    with running(limited, {"PYTHONDONTWRITEBYTECODE": "1"}) as process:
        _, err = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 2 and err.startswith("omnid: ") and err.count("\n") == 1 and str(tum) in err
    assert 0 < len(rows(tum)) < PAIRS
