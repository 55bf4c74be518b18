"""Installation as a service, into a folder that stands for the system."""

from __future__ import annotations

import shutil
import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

from omnid.config import Config, load_config
from omnid.errors import OmnidError
from omnid.service.install import SHIPPED_PROGRAM, Installation, exec_word, service_file
from tests.replay.command import Command

ROOT = Path(__file__).parents[3]
FILES = ("etc/systemd/system/omnid.service", "etc/udev/rules.d/90-omnid.rules", "etc/omnid/omnid.toml")


def test_writes_the_unit_of_this_program_and_keeps_edited_files(omnid: Command, tmp_path: Path) -> None:
    listed = omnid("install-service", "--root", tmp_path, "--dry-run").out
    assert [str(tmp_path / name) for name in FILES] == [line.split()[1] for line in listed.splitlines()]
    assert list(tmp_path.iterdir()) == []
    done = omnid("install-service", "--root", tmp_path, "--yes")
    assert done.code == 0 and "doctor" in done.out
    unit, rules, config = (tmp_path / name for name in FILES)
    assert "ExecStart=/srv/robot/bin/omnid run --config /etc/omnid/omnid.toml\n" in unit.read_text()
    assert "/opt/omnid" not in unit.read_text()
    assert rules.read_text() == (ROOT / "systemd" / rules.name).read_text()
    assert load_config(config) == Config()
    assert omnid("install-service", "--root", tmp_path).out == "nothing to do\n"
    rules.write_text("mine")
    unit.write_text("older")
    assert omnid("install-service", "--root", tmp_path, "--yes").out.startswith(f"replace {unit}\n")
    assert rules.read_text() == "mine" and "ExecStart" in unit.read_text()


def test_the_page_is_a_unit_of_its_own(omnid: Command, tmp_path: Path) -> None:
    done = omnid("install-service", "--root", tmp_path, "--yes", "--page")
    assert done.code == 0 and "enable --now omnid omnid-web" in done.out
    unit = (tmp_path / "etc/systemd/system/omnid-web.service").read_text()
    assert "ExecStart=/srv/robot/bin/omnid web --config /etc/omnid/omnid.toml" in unit and "/opt/omnid" not in unit
    assert omnid("install-service", "--root", tmp_path, "--page").out == "nothing to do\n"


def test_asks_first(omnid: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("builtins.input", lambda _: "n")
    done = omnid("install-service", "--root", tmp_path)
    assert done.code == 1 and done.out.endswith("nothing was changed\n") and list(tmp_path.iterdir()) == []
    monkeypatch.setattr("builtins.input", lambda _: "y")
    assert omnid("install-service", "--root", tmp_path).code == 0 and (tmp_path / FILES[0]).exists()


def test_a_folder_that_cannot_be_written_is_one_line(omnid: Command, tmp_path: Path) -> None:
    (tmp_path / "etc").write_text("a file")
    done = omnid("install-service", "--root", tmp_path, "--yes")
    assert done.code == 2 and done.err.count("\n") == 1 and "sudo" in done.err


@pytest.mark.parametrize("program", ["/home/me/.venv/bin/omnid", "/root/omnid/bin/omnid", "/tmp/v/bin/omnid"])
def test_refuses_a_program_that_the_unit_cannot_see(tmp_path: Path, program: str) -> None:
    with pytest.raises(OmnidError, match="/opt/omnid"):
        Installation(tmp_path, Path(program)).steps()


@pytest.mark.parametrize(
    ("name", "unit"),
    [("with space", "omnid.service"), ("100%n", "omnid-web.service"), ("a %n ; ${HOME} größe", "omnid.service")],
)
@pytest.mark.skipif(not shutil.which("systemd-analyze"), reason="apt-get install systemd")
def test_systemd_starts_a_program_of_any_name(tmp_path: Path, name: str, unit: str) -> None:
    """Without the program systemd names the path that it has read."""
    program = tmp_path / name / "bin" / "omnid"
    path = tmp_path / unit
    path.write_text(service_file(unit).replace(SHIPPED_PROGRAM, exec_word(program)))
    verify = ["systemd-analyze", "verify", "--man=no", path]
    missing = subprocess.run(verify, capture_output=True, text=True, timeout=60)
    assert f"Command {program} is not executable: No such file or directory" in missing.stderr
    program.parent.mkdir(parents=True)
    program.write_text("#!/bin/sh\n")
    program.chmod(0o755)
    done = subprocess.run(verify, capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stdout + done.stderr) == (0, "")


@pytest.mark.parametrize(
    "name", ["two\nExecStartPre=/bin/evil", "tab\t", "\udcff", "\x1b[2J", 'a "b"', "a 'b'", "a\\x41"]
)
def test_refuses_a_program_that_no_unit_can_name(
    omnid: Command, tmp_path: Path, name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sys, "prefix", f"/srv/{name}")
    assert "characters that a systemd unit cannot name" in omnid.refused("install-service", "--root", tmp_path, "--yes")
    assert list(tmp_path.iterdir()) == []


def test_the_files_are_found_in_a_clone() -> None:
    assert service_file("omnid.service") == (ROOT / "systemd" / "omnid.service").read_text()


@pytest.mark.slow
def test_the_wheel_carries_the_files(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "pip", "wheel", "-q", "--no-deps", "-w", tmp_path, ROOT]
    subprocess.run(command, check=True, capture_output=True)
    with zipfile.ZipFile(next(tmp_path.glob("*.whl"))) as wheel:
        names = wheel.namelist()
        assert {"omnid/service/systemd/omnid.service", "omnid/py.typed", "omnid/sample/log.mcap"} <= set(names)
        assert not [name for name in names if name.startswith("tests/")]
        metadata = wheel.read(next(name for name in names if name.endswith("METADATA"))).decode()
    assert "License-Expression: Apache-2.0" in metadata
