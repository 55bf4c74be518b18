"""Files installed beside the program: systemd and udev accept them without a message, and the unit is sandboxed."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from drivers.cameras.v4l2_device import CaptureDevice, udev_rules
from omnid.engine.realtime import RealtimeSettings

SYSTEMD = Path(__file__).parents[2] / "systemd"
UNIT = SYSTEMD / "omnid.service"
RULES = SYSTEMD / "90-omnid.rules"
COMMAND = "/opt/omnid/bin/omnid run --config /etc/omnid/omnid.toml"
WORST_EXPOSURE = 3.0
DAEMON_MB = 260  # measured with the default settings
with_systemd = pytest.mark.skipif(not shutil.which("systemd-analyze"), reason="apt-get install systemd")


@pytest.fixture
def installed(tmp_path: Path) -> Path:
    """The unit with its drop-in, of a program that is there."""
    unit = tmp_path / "omnid.service"
    text = UNIT.read_text()
    assert text.count(f"ExecStart={COMMAND}\n") == 1
    unit.write_text(text.replace("/opt/omnid/bin/omnid", sys.executable))
    folder = tmp_path / "omnid.service.d"
    folder.mkdir()
    shutil.copy(SYSTEMD / "lan.conf", folder)
    return unit


def analyze(*words: str | Path) -> subprocess.CompletedProcess[str]:
    """Run systemd-analyze."""
    return subprocess.run(["systemd-analyze", *words], capture_output=True, text=True, timeout=60)


def verify(unit: Path) -> tuple[int, str]:
    """Exit code and what was said; it is 0 also where keys are unknown."""
    done = analyze("verify", "--man=no", unit)
    return done.returncode, done.stderr + done.stdout


@with_systemd
@pytest.mark.parametrize("file", ["omnid.service", "omnid.service.d/lan.conf"])
def test_the_unit_is_taken_without_a_word_and_a_mistake_is_reported(installed: Path, file: str) -> None:
    assert verify(installed) == (0, "")
    changed = installed.parent / file
    changed.write_text(changed.read_text().replace("IPAddressAllow=", "IPAddressAllowed="))
    assert "IPAddressAllowed" in verify(installed)[1]


@with_systemd
def test_the_units_are_well_locked_up(installed: Path, tmp_path: Path) -> None:
    page = tmp_path / "omnid-web.service"
    page.write_text((SYSTEMD / page.name).read_text().replace("/opt/omnid/bin/omnid", sys.executable))
    assert verify(page) == (0, "")
    for unit in (installed, page):
        done = analyze("security", "--offline=true", "--no-pager", unit)
        found = re.search(r"Overall exposure level for \S+: (\S+)", done.stdout)
        assert found and float(found[1]) <= WORST_EXPOSURE, done


def settings() -> dict[str, str]:
    """The unit's keys, each with its last value."""
    lines = [line for line in UNIT.read_text().splitlines() if re.match(r"[A-Z]\w*=", line)]
    return {key: value for key, _, value in (line.partition("=") for line in lines)}


def test_the_unit_allows_what_the_configuration_asks_for() -> None:
    unit, wanted = settings(), RealtimeSettings()
    assert int(unit["LimitRTPRIO"]) >= max(wanted.motor_priority, wanted.capture_priority)
    assert wanted.lock_memory and unit["LimitMEMLOCK"] == "infinity"
    assert unit["Type"] == "notify" and float(unit["WatchdogSec"]) > 3 and unit["Restart"] == "on-failure"
    assert "RestrictRealtime" not in unit and unit["UMask"] == "0027"  # recordings are not for all users
    limit = unit["MemoryMax"]
    assert limit.endswith("M") and 2 * DAEMON_MB <= int(limit[:-1]) <= 4 * DAEMON_MB


def test_the_examples_of_udev_are_commented_and_those_of_cameras_are_what_omnid_cameras_prints() -> None:
    lines = RULES.read_text().splitlines()
    assert all(line.startswith("#") for line in lines if line)  # before somebody puts in his ports
    examples = [line[1:] for line in lines if line.startswith('#SUBSYSTEM=="video4linux"')]
    ports = [re.search(r'ID_PATH}=="(.*?)"', line)[1] for line in examples]  # type: ignore[index]
    devices = [
        CaptureDevice(f"/dev/video{number}", "HD Webcam", "uvcvideo", "", "", "", port)
        for number, port in enumerate(ports)
    ]
    assert list(udev_rules(devices)) == examples and len(examples) == 2
