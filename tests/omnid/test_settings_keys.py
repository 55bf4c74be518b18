"""Keys of earlier versions are refused with their new names, and misspelt ones with those that are alike."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from omnid.errors import OmnidError
from omnid.settings import load, parse
from tests.omnid.sample_settings import Config, written

RENAMED = {
    "depth.window": "stereo.window_px",
    "wheels": "motor",
    "wheels.port": "motor.serial.port",
    "wheels.top_mps": "the base keeps its own limit, set it there",
    "stereo.window": "stereo.window_px",
}


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("depth.window", "depth.window is now called stereo.window_px"),
        ("stereo.window", "stereo.window is now called stereo.window_px"),
        ("wheels.limit_mps", "wheels.limit_mps is now called motor.limit_mps"),
        ("wheels.serial.bauds", "wheels.serial.bauds is now called motor.serial.bauds"),
        ("wheels.port", "wheels.port is now called motor.serial.port"),
        ("wheels.top_mps", "wheels.top_mps was removed: the base keeps its own limit, set it there"),
        ("wheels.colour", "wheels is now called motor, which has no colour"),
        ("depth.widow", "unknown key depth"),
    ],
)
def test_refuses_a_key_of_an_earlier_version_with_its_new_name(tmp_path: Path, name: str, expected: str) -> None:
    section, _, key = name.rpartition(".")
    with pytest.raises(OmnidError) as in_file:
        load(Config, written(tmp_path, f"robot = 'r2'\n[{section}]\n{key} = 5"), renamed=RENAMED)
    assert str(in_file.value).startswith(f"{tmp_path / 'omnid.toml'}: {expected}")
    with pytest.raises(OmnidError) as in_override:
        load(Config, None, [f"{name}=5"], renamed=RENAMED)
    assert str(in_override.value).startswith(f"override '{name}=5': {expected}")
    assert "\n" not in str(in_file.value) + str(in_override.value)


def test_refuses_an_empty_section_of_an_earlier_version() -> None:
    with pytest.raises(OmnidError, match=r"^omnid\.toml: wheels is now called motor$"):
        parse(Config, b"[wheels]", origin="omnid.toml", renamed=RENAMED)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("[stereo]\nwindow = 5", "unknown key stereo.window: did you mean stereo.window_px?"),
        ("window_px = 5", "unknown key window_px: did you mean stereo.window_px?"),
        ("[stero]\nwindow_px = 5", "unknown key stero: did you mean stereo?"),
        ("[motor.serial]\nprot = 'x'", "unknown key motor.serial.prot: did you mean motor.serial.port?"),
        ("[stereo]\nzzz = 5", "unknown key stereo.zzz: known are stereo.window_px, "),
        ('"a\\nb" = 1', "unknown key 'a\\nb': known are robot, "),
    ],
)
def test_an_unknown_key_is_answered_by_those_that_are_alike(text: str, expected: str) -> None:
    with pytest.raises(OmnidError, match=f"^{re.escape(f'omnid.toml: {expected}')}"):
        parse(Config, text.encode(), origin="omnid.toml")
