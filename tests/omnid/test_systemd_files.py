"""Files installed beside the program: systemd and udev accept them without a message, and the unit is sandboxed."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Iterator
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
PART = re.compile(r'([A-Z_]+)(?:\{([\w./-]+)\})?(==|!=|\+=|=|:=)"((?:[^"\\]|\\.)*)"')
MATCHED = {"SUBSYSTEM", "ATTR", "ATTRS", "ENV", "KERNEL"}  # the keys of udev(7) that the examples use
ASSIGNED = {"SYMLINK", "ENV"}
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
def test_the_unit_is_taken_without_a_word(installed: Path) -> None:
    assert verify(installed) == (0, "")


@with_systemd
@pytest.mark.parametrize("file", ["omnid.service", "omnid.service.d/lan.conf"])
def test_reports_a_mistake_in_the_unit(installed: Path, file: str) -> None:
    changed = installed.parent / file
    changed.write_text(changed.read_text().replace("IPAddressAllow=", "IPAddressAllowed="))
    assert "IPAddressAllowed" in verify(installed)[1]


@with_systemd
def test_the_unit_is_well_locked_up(installed: Path) -> None:
    done = analyze("security", "--offline=true", "--no-pager", installed)
    found = re.search(r"Overall exposure level for omnid.service: (\S+)", done.stdout)
    assert found, done.stderr
    assert float(found[1]) <= WORST_EXPOSURE, done.stdout


@with_systemd
def test_the_unit_of_the_page_is_taken_without_a_word_and_locked_up(tmp_path: Path) -> None:
    unit = tmp_path / "omnid-web.service"
    unit.write_text((SYSTEMD / unit.name).read_text().replace("/opt/omnid/bin/omnid", sys.executable))
    assert verify(unit) == (0, "")
    found = re.search(
        r"Overall exposure level for omnid-web.service: (\S+)",
        analyze("security", "--offline=true", "--no-pager", unit).stdout,
    )
    assert found and float(found[1]) <= WORST_EXPOSURE


def settings() -> dict[str, str]:
    """The unit's keys, each with its last value."""
    lines = [line for line in UNIT.read_text().splitlines() if re.match(r"[A-Z]\w*=", line)]
    return {key: value for key, _, value in (line.partition("=") for line in lines)}


def test_the_unit_allows_what_the_configuration_asks_for() -> None:
    unit, wanted = settings(), RealtimeSettings()
    assert int(unit["LimitRTPRIO"]) >= max(wanted.motor_priority, wanted.capture_priority)
    assert wanted.lock_memory and unit["LimitMEMLOCK"] == "infinity"
    assert unit["Type"] == "notify" and float(unit["WatchdogSec"]) > 3 and unit["Restart"] == "on-failure"
    assert "RestrictRealtime" not in unit


def test_recordings_are_not_readable_by_other_users() -> None:
    assert settings()["UMask"] == "0027"


def test_the_unit_limits_the_memory_to_two_to_four_times_what_the_daemon_needs() -> None:
    limit = settings()["MemoryMax"]
    assert limit.endswith("M") and 2 * DAEMON_MB <= int(limit[:-1]) <= 4 * DAEMON_MB


def test_what_the_unit_starts_is_shipped() -> None:
    """The program's name is that of the package, its configuration that beside the unit."""
    project = tomllib.loads((SYSTEMD.parent / "pyproject.toml").read_text())["project"]
    words = COMMAND.split()
    assert Path(words[0]).name in project["scripts"]
    assert (SYSTEMD / Path(words[-1]).name).is_file()


def rules(text: str, commented: bool) -> Iterator[list[tuple[str, str, str, str]]]:
    """The rules in the text, each as (key, attribute, operator, value); ValueError where one is none."""
    for line in text.splitlines():
        if line.startswith("#SUBSYSTEM") and commented:
            line = line[1:]
        if line and not line.startswith("#"):
            parts = PART.findall(line)
            if (
                ", ".join(
                    f'{key}{"{" + attribute + "}" if attribute else ""}{operator}"{value}"'
                    for key, attribute, operator, value in parts
                )
                != line
            ):
                raise ValueError(f"no udev rule: {line}")
            yield parts


def check(parts: list[tuple[str, str, str, str]]) -> None:
    """Matches before assignments, each with a key that can be matched or assigned."""
    operators = [operator for _, _, operator, _ in parts]
    assert operators == sorted(operators, key=lambda operator: operator not in ("==", "!="))
    for key, attribute, operator, _ in parts:
        assert key in (MATCHED if operator in ("==", "!=") else ASSIGNED)
        assert bool(attribute) == (key in ("ATTR", "ATTRS", "ENV"))


def test_the_examples_are_rules() -> None:
    found = list(rules(RULES.read_text(), commented=True))
    for parts in found:
        check(parts)
    assert [value for parts in found for key, _, operator, value in parts if (key, operator) == ("SYMLINK", "+=")] == [
        "omnid/lower",
        "omnid/upper",
        "omnid/motor",
    ]


def test_nothing_is_renamed_before_somebody_puts_in_his_ports() -> None:
    assert list(rules(RULES.read_text(), commented=False)) == []


def test_the_examples_of_the_cameras_are_what_omnid_cameras_prints() -> None:
    examples = [line[1:] for line in RULES.read_text().splitlines() if line.startswith('#SUBSYSTEM=="video4linux"')]
    ports = [re.search(r'ID_PATH}=="(.*?)"', line)[1] for line in examples]  # type: ignore[index]
    devices = [
        CaptureDevice(f"/dev/video{number}", "HD Webcam", "uvcvideo", "", "", "", port)
        for number, port in enumerate(ports)
    ]
    assert list(udev_rules(devices)) == examples


@pytest.mark.parametrize("line", ["SUBSYSTEM==tty", 'SUBSYSTEM=="tty" SYMLINK+="x"', 'SUBSYSTEM=="tty", ', "nonsense"])
def test_what_is_no_rule_is_found(line: str) -> None:
    with pytest.raises(ValueError, match="no udev rule"):
        list(rules(line, commented=False))
