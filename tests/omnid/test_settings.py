"""Settings: every value is checked, every error names the dotted path, a dump reads back as the same object."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import pytest

from omnid.errors import OmnidError
from omnid.settings import load, parse
from tests.omnid.sample_settings import Config, Motor, Serial, Stereo, written


def refusal(text: str | bytes, *overrides: str) -> str:
    data = text if isinstance(text, bytes) else text.encode()
    with pytest.raises(OmnidError) as caught:
        parse(Config, data, origin="omnid.toml", overrides=overrides)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 400
    return str(caught.value)


def test_returns_the_defaults_without_a_file() -> None:
    assert load(Config) == Config()


def test_a_file_changes_what_it_names_and_nothing_else(tmp_path: Path) -> None:
    settings = load(Config, written(tmp_path, "robot = 'r2'\n[stereo]\nratio = 1\n[motor.serial]\nport = 'x'"))
    assert settings == Config(
        robot="r2", stereo=Stereo(ratio=1.0), motor=Motor(limit_mps=-1.0, serial=Serial("x", (57600,)))
    )
    assert isinstance(settings.stereo.ratio, float)


@pytest.mark.parametrize(
    ("override", "value"),
    [("robot=seven", "seven"), ("robot=7", "7"), ("robot='7'", "7"), ("robot=true", "true"), ("robot=a=b", "a=b")],
)
def test_takes_a_string_without_quotes_in_an_override(override: str, value: str) -> None:
    assert load(Config, None, [override]).robot == value


def test_overrides_win_over_the_file_and_later_ones_over_earlier(tmp_path: Path) -> None:
    path = written(tmp_path, "stereo.window_px = 5")
    assert load(Config, path, ["stereo.window_px=7", " stereo.window_px = 9 "]).stereo.window_px == 9


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (f"{'q' * 300} = 1", "unknown key 'qqq"),
        (f"{'q' * 100_000} = 1", "keys and numbers of at most 400 characters"),
        ("a." * 20_000 + "a = 1", "a key of at most 9 parts"),
        ("stereo = 5", "stereo: expected a section, found 5"),
        ("robot.name = 'x'", "robot: expected a string, found a section"),
        ("stereo.window_px = '11'", "stereo.window_px: expected an integer from 3 to 31, found '11'"),
        ("stereo.window_px = 11.0", "expected an integer from 3 to 31, found 11.0"),
        ("stereo.window_px = true", "expected an integer from 3 to 31, found True"),
        ("stereo.window_px = 2", "expected an integer from 3 to 31, found 2"),
        ("stereo.window_px = 32", "expected an integer from 3 to 31, found 32"),
        ("stereo.subpixel = 1", "stereo.subpixel: expected true or false, found 1"),
        ("stereo.ratio = true", "stereo.ratio: expected a number from 0.0 to 1.0, found True"),
        ("stereo.ratio = nan", "found nan"),
        ("stereo.ratio = inf", "found inf"),
        ("motor.limit_mps = 0.5", "motor.limit_mps: expected a number of at most 0, found 0.5"),
        ("stereo.method = 'ncc'", "stereo.method: expected a string, one of 'sad', 'census', found 'ncc'"),
        ("robot = 1979-05-27", "robot: expected a string, found datetime.date"),
        ("offset_m = [1, 2]", "offset_m: expected a list of 3 numbers, found [1, 2]"),
        ("offset_m = [1, 2, 'x']", "offset_m: expected a list of 3 numbers, found [1, 2, 'x']"),
        ("offset_m = [1, 2, 1e999]", "offset_m: expected a list of 3 numbers, found [1, 2, inf]"),
        ("topics = 'a'", "topics: expected a list of strings, found 'a'"),
        ("motor.serial.bauds = [9600, true]", "expected a list of integers of at least 1, found [9600, True]"),
        ("motor.serial.bauds = [0]", "expected a list of integers of at least 1, found [0]"),
        (f"stereo.ratio = 0x{'f' * 5000}", "keys and numbers of at most 400 characters"),
        (f"stereo.window_px = {'9' * 5000}", "expected TOML, found: "),
        (f"topics = {'[' * 20_000}", "expected TOML, found: "),
        ("stereo.window_px 5", "expected TOML, found: "),
        ("robot = 1\nrobot = 2", "expected TOML, found: "),
        (b"robot = '\xff'", "expected TOML in UTF-8, found another byte at offset 9"),
        (bytes(range(256)), "omnid.toml: expected TOML"),
    ],
)
def test_refuses_values_that_are_not_as_declared(text: str | bytes, expected: str) -> None:
    message = refusal(text)
    assert message.startswith("omnid.toml: ")
    assert expected in message


@pytest.mark.parametrize(
    ("override", "expected"),
    [
        ("stereo.window_px", "expected section.key=value, found no '='"),
        ("stereo=5", "stereo is a section: name one of its keys, such as stereo.window_px"),
        ("stereo.window=5", "did you mean stereo.window_px?"),
        ("robot.name=5", "robot is a key, not a section: it has no name"),
        ("stereo.window_px=99", "stereo.window_px: expected an integer from 3 to 31, found 99"),
        ("stereo.window_px=5\nrobot='x'", "expected an integer from 3 to 31, found \"5\\nrobot='x'\""),
        ("stereo.subpixel=yes", "stereo.subpixel: expected true or false, found 'yes'"),
        ("=5", "unknown key"),
        ("robot=a\udcff", "robot: expected a string, found 'a\\udcff'"),
    ],
)
def test_refuses_a_wrong_override(override: str, expected: str) -> None:
    message = refusal("", override)
    assert message.startswith("override ")
    assert expected in message


def test_refuses_an_override_below_a_value_of_the_file() -> None:
    assert "stereo: expected a section, found 5" in refusal("stereo = 5", "stereo.window_px=5")


def test_names_a_file_that_cannot_be_read(tmp_path: Path) -> None:
    for path in (tmp_path / "missing.toml", tmp_path, Path("a\0b"), written(tmp_path, b"#" * (1 << 20) + b"#")):
        with pytest.raises(OmnidError, match=r"settings file .*(omnid|missing|test_|a\\x00b)"):
            load(Config, path)


@dataclass(frozen=True, slots=True)
class Bare:
    speed_mps: float = 1.0


def test_raises_a_type_error_for_a_field_that_is_no_knob() -> None:
    with pytest.raises(TypeError, match="speed_mps"):
        load(Bare)
