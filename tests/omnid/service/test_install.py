"""The service: its files satisfy systemd and udev, and are installed into a folder that stands for the system."""

from __future__ import annotations

import io
import re
import shutil
import subprocess
import sys
from functools import partial
from pathlib import Path

import pytest

from omnid.config import Config, load_config
from omnid.engine.process import RealtimeSettings
from omnid.errors import OmnidError
from omnid.service import install
from tests.replay.command import Command

ROOT = Path(__file__).parents[3]
SYSTEMD = ROOT / "systemd"
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
    """Return the exit code, which is 0 for unknown keys, too, and the messages."""
    done = analyze("verify", "--man=no", unit)
    return done.returncode, done.stderr + done.stdout


@with_systemd
@pytest.mark.parametrize("file", ["omnid.service", "omnid.service.d/lan.conf"])
def test_systemd_accepts_the_unit_and_reports_a_mistake(installed: Path, file: str) -> None:
    assert verify(installed) == (0, "")
    changed = installed.parent / file
    changed.write_text(changed.read_text().replace("IPAddressAllow=", "IPAddressAllowed="))
    assert "IPAddressAllowed" in verify(installed)[1]


@with_systemd
def test_the_units_have_few_rights(installed: Path, tmp_path: Path) -> None:
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
    assert unit["LimitMEMLOCK"] == "infinity"
    assert unit["Type"] == "notify" and float(unit["WatchdogSec"]) > 3 and unit["Restart"] == "on-failure"
    assert "RestrictRealtime" not in unit and unit["UMask"] == "0027"  # recordings are not for all users
    limit = unit["MemoryMax"]
    assert limit.endswith("M") and 2 * DAEMON_MB <= int(limit[:-1]) <= 4 * DAEMON_MB


def test_the_examples_of_udev_are_commented() -> None:
    lines = RULES.read_text().splitlines()
    assert all(line.startswith("#") for line in lines if line)  # before somebody enters their ports


FILES = ("etc/systemd/system/omnid.service", "etc/udev/rules.d/90-omnid.rules", "etc/omnid/omnid.toml")


def test_the_unit_of_this_program_is_written_and_edited_files_are_kept(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The command asks first."""
    omnid = Command(capsys)
    monkeypatch.setattr(sys, "prefix", "/srv/robot")
    monkeypatch.setattr(install, "files_to_write", partial(install.files_to_write, root=tmp_path))
    monkeypatch.setattr(sys, "stdin", io.StringIO("n\ny\n"))
    # 1. What would be written, and what was.
    listed = omnid("install-service", "--dry-run").out
    unit, rules, config = (tmp_path / name for name in FILES)
    assert [f"write {path}" for path in (unit, rules, config)] == listed.splitlines()
    refused = omnid("install-service")
    assert refused.code == 1 and refused.out.endswith("nothing was changed\n") and list(tmp_path.iterdir()) == []
    agreed = omnid("install-service")
    assert agreed.code == 0 and "enable --now omnid" in agreed.out and "useradd" in agreed.out
    assert "ExecStart=/srv/robot/bin/omnid run --config /etc/omnid/omnid.toml\n" in unit.read_text()
    assert "/opt/omnid" not in unit.read_text() and load_config(config) == Config()
    assert rules.read_text() == (ROOT / "systemd" / rules.name).read_text()
    assert omnid("install-service").out == "nothing to do\n"
    # 2. Files that people edit are kept.
    rules.write_text("mine")
    unit.write_text("older")
    again = omnid("install-service", "--yes", "--page").out
    assert f"write {unit}" in again and rules.read_text() == "mine" and "ExecStart" in unit.read_text()
    page = (tmp_path / "etc/systemd/system/omnid-web.service").read_text()
    assert "ExecStart=/srv/robot/bin/omnid web --config /etc/omnid/omnid.toml" in page and "/opt/omnid" not in page
    # 3. A system that cannot be changed.
    shutil.rmtree(tmp_path / "etc")
    (tmp_path / "etc").write_text("a file")
    failed = omnid("install-service", "--yes")
    assert failed.code == 2 and failed.err.count("\n") == 1 and "sudo" in failed.err


@pytest.mark.parametrize(
    ("program", "message"),
    [
        ("/home/me/v/omnid", "a folder that the service cannot see"),
        ("/srv/100%n", "characters that a systemd unit cannot name"),
        ("/srv/two\nExecStartPre=/bin/evil", "characters that a systemd unit cannot name"),
    ],
)
def test_a_program_that_the_unit_cannot_start_is_refused(program: str, message: str) -> None:
    with pytest.raises(OmnidError, match=message):
        install.files_to_write(Path(program))
