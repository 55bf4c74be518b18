"""Settings files of earlier versions are read with their keys under the new names."""

from __future__ import annotations

from pathlib import Path

import pytest

from omnid.errors import OmnidError
from omnid.settings_migration import load_renamed
from tests.omnid.sample_settings import Config, Motor, Serial, Stereo, written

RENAMED = {
    "wheels": "motor",
    "wheels.port": "motor.serial.port",
    "motor.top_mps": "the base keeps its own limit, set it there",
    "stereo.window": "stereo.window_px",
}


def test_keys_and_sections_are_moved_and_each_has_a_line(tmp_path: Path) -> None:
    text = "[stereo]\nwindow = 5\n[wheels]\nlimit_mps = -2\nport = 'x'\n"
    settings, lines = load_renamed(Config, written(tmp_path, text), RENAMED)
    serial = Serial("x", (57600,))
    assert settings == Config(stereo=Stereo(window_px=5), motor=Motor(limit_mps=-2.0, serial=serial))
    assert sorted(lines) == [
        "stereo.window is now called stereo.window_px",
        "wheels is now called motor",
        "wheels.port is now called motor.serial.port",
    ]


def test_a_file_of_this_version_has_no_lines(tmp_path: Path) -> None:
    assert load_renamed(Config, written(tmp_path, "robot = 'r2'"), RENAMED) == (Config(robot="r2"), [])


def test_a_removed_key_is_refused(tmp_path: Path) -> None:
    with pytest.raises(OmnidError, match=r"motor\.top_mps was removed"):
        load_renamed(Config, written(tmp_path, "[motor]\ntop_mps = 1"), RENAMED)
