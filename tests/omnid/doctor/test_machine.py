"""Checks of the machine."""

from __future__ import annotations

import os
import shutil
from pathlib import Path

import pytest

from omnid.config import RecordConfig
from omnid.doctor import machine
from omnid.doctor.machine import BUILT_S, clock, compiled_functions, disk, is_synchronised, programs
from omnid.engine.kernel_store import cache_folder

ROOT = Path(__file__).parents[3]


UNPRIVILEGED = 65534


@pytest.mark.parametrize(
    ("now_s", "synchronised", "level"),
    [(BUILT_S + 1e8, True, "ok"), (BUILT_S + 1e8, False, "warning"), (0.0, True, "error")],
)
def test_checks_the_system_time(now_s: float, synchronised: bool, level: str, tmp_path: Path) -> None:
    assert next(clock(now_s, synchronised, tmp_path)).level == level
    assert is_synchronised() in (True, False)


@pytest.mark.parametrize(("source", "level"), [("tsc", "ok"), ("arch_sys_counter", "ok"), ("hpet", "warning")])
def test_checks_the_clock_source(source: str, level: str, tmp_path: Path) -> None:
    folder = tmp_path / "sys/devices/system/clocksource/clocksource0"
    folder.mkdir(parents=True)
    (folder / "current_clocksource").write_text(f"{source}\n")
    found = list(clock(BUILT_S + 1e8, True, tmp_path))[1]
    assert found.level == level and source in found.found


def test_checks_the_space_for_recordings() -> None:
    (found,) = disk(machine.STATE / "not" / "yet", RecordConfig(keep_mb=10, free_mb=0), 1e6)
    assert found.level == "ok" and f"free at {machine.STATE.parent}" in found.found and "newest 0.0 GB" in found.found
    full = 10**9
    (found,) = disk(machine.STATE, RecordConfig(free_mb=full), 1e6)
    assert found.level == "warning" and f"record.free_mb = {full}" in found.found
    (found,) = disk(machine.STATE, RecordConfig(enabled=True, free_mb=full), 1e6)
    assert found.level == "error"


def test_warns_of_a_folder_outside_the_state_directory(tmp_path: Path) -> None:
    *_, found = disk(tmp_path, RecordConfig(free_mb=0), 1e6)
    assert found.level == "warning" and f"ReadWritePaths={tmp_path}" in found.advice
    unit = (ROOT / "systemd" / "omnid.service").read_text()
    assert f"\nWorkingDirectory={machine.STATE}\n" in unit and f"\nStateDirectory={machine.STATE.name}\n" in unit


def test_checks_the_packages(monkeypatch: pytest.MonkeyPatch) -> None:
    (found,) = programs()
    assert found.level == "ok" and "cv2" in found.found and "zenoh 1." in found.found
    monkeypatch.setitem(machine.PACKAGES, "missing-package", "missing_part")  # type: ignore[attr-defined]
    assert [finding.level for finding in programs()] == ["error", "ok"]


def test_tells_whether_functions_are_compiled(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    nowhere = tmp_path / "no service"
    (kept,) = compiled_functions(nowhere)
    assert kept.level == "ok" and " functions in " in kept.found, "conftest.py has compiled them"
    monkeypatch.setenv("OMNID_CACHE_DIR", str(tmp_path / "empty"))
    (empty,) = compiled_functions(nowhere)
    assert empty.level == "ok" and "will be compiled at the next start" in empty.found
    (tmp_path / "file").touch()
    monkeypatch.setenv("OMNID_CACHE_DIR", str(tmp_path / "file" / "cache"))
    (refused,) = compiled_functions(nowhere)
    assert refused.level == "warning" and "Not a directory" in refused.found and "OMNID_CACHE_DIR" in refused.advice


@pytest.mark.skipif(os.geteuid() != 0, reason="only root reads the service's cache")
def test_root_learns_of_the_services_functions(tmp_path: Path) -> None:
    service = tmp_path / "service"
    shutil.copytree(cache_folder(), service, ignore=shutil.ignore_patterns("making-*"))
    for path in (service, *service.rglob("*")):
        os.chown(path, UNPRIVILEGED, UNPRIVILEGED)
    (kept,) = compiled_functions(service)
    assert kept.level == "ok" and str(service) in kept.found and " functions in " in kept.found
    for folder in service.glob("kernels-*"):
        folder.chmod(0o777)
    (open_to_all,) = compiled_functions(service)
    assert "will be compiled" in open_to_all.found
