"""Settings as files, JSON on the standard output, and the options of the daemon."""

from __future__ import annotations

import json
import os
import pty
import re
import subprocess
import sys
from importlib.resources import files
from pathlib import Path
from typing import Any

from omnid.config import Config, load_config
from tests.omnid.transport.bus_fixtures import free_endpoint
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


def test_check_lists_what_differs(omnid: Command, tmp_path: Path) -> None:
    file = tmp_path / "omnid.toml"
    file.write_text("[bus]\nrobot = 'rover'\n")
    assert omnid("config", "check", file).out == (
        f"{file}: good; 1 settings differ from their defaults\nbus.robot = 'rover', default 'omnid'\n"
    )
    file.write_text("[bus]\nrobots = 'rover'\n")
    assert "did you mean bus.robot?" in omnid.refused("config", "check", file)
    file.write_text("[motor]\nprotocol = 'waveshare_json'\n")
    assert "expected one of line, roboteq" in omnid.refused("config", "check", file)
    assert "expected one of line, roboteq" in omnid.refused("motor", "test", "--motor", "simulated", "--config", file)
    file.write_text("[bus]\nrobot = 'a/*'\n")
    assert "bus.robot is 'a/*'" in omnid.refused("config", "check", file)


FEW = 8  # pairs of a replay of 0.75 s


def loaded(omnid: Command, *words: object, code: int = 0) -> Any:
    done = omnid(*words, "--json")
    assert done.code == code, done.err
    return json.loads(done.out)


def test_results_of_a_replay_as_json(omnid: Command, scene: Path, tmp_path: Path) -> None:
    tum = tmp_path / "est.txt"
    words = ("replay", scene / "log.mcap", "--rig", scene / "rig.toml", "--quiet", "--inline", "--seconds", 0.75)
    first = loaded(omnid, *words, "--tum", tum)
    assert first["counters"]["poses"] == FEW and first["counters"]["states"]["tracking"] == FEW
    assert first["timings"]["odometry"]["n"] == FEW and first["signal"] == 0 and len(first["warnings"]) == 1
    assert 0 < first["elapsed_s"] < 600
    metrics = loaded(omnid, "eval", tum, scene / "truth.txt")
    assert metrics["pairs"] == FEW and 0 < metrics["ate_rmse_m"] < 0.05


SAMPLE = Path(str(files("omnid.sample") / "log.mcap"))


def test_says_that_it_is_ready_and_ends_with_a_summary(tmp_path: Path) -> None:
    log, endpoint = tmp_path / "log.mcap", free_endpoint()
    with SAMPLE.open("rb") as sample:
        log.write_bytes(sample.read(450_000))
    master, slave = pty.openpty()
    command = [
        sys.executable,
        "-m",
        "omnid",
        "run",
        "--log",
        str(log),
        "--once",
        "--motor",
        "simulated",
        "--set",
        f'bus.listen=["{endpoint}"]',
    ]
    with subprocess.Popen(command, stdout=slave, stderr=slave, stdin=subprocess.DEVNULL) as process:
        os.close(slave)
        shown = b""
        while data := _read(master):
            shown += data
        assert process.wait() == 0
    os.close(master)
    text = shown.decode()
    ready = f"omnid: ready: poses of 'omnid' at {endpoint} (`omnid listen`); the wheels turn after `omnid arm`"
    assert ready in text and re.search(r"\x1b\[K\d+\.\d\d m .* poses/s, ", text)
    last = re.findall(r"omnid: .*", text)[-1]  # numba resets colours behind it where colorama is installed
    assert re.match(r"omnid: ended: \d+ poses, \d+\.\d\d m, 0 resets; tracking \d+", last)


def _read(master: int) -> bytes:
    try:
        return os.read(master, 4096)
    except OSError:  # the program has ended
        return b""
