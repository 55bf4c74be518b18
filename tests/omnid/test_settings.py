"""Settings: every value is checked, errors name the dotted path, dumps read back; the shipped file is the default."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import pytest
from msgspec import Meta

from calib.typed_toml import key_paths
from calib.validation import MAX_FILE_BYTES
from omnid.config import FIRST_SETTINGS, Config, load_config, unused_settings
from omnid.errors import OmnidError
from omnid.settings import dump, load, parse


@dataclass(frozen=True, slots=True)
class Stereo:
    window_px: Annotated[int, Meta(ge=3, le=31), "side of the matching window, px"] = 11
    ratio: Annotated[float, Meta(ge=0.0, le=1.0), "second best over best, 1"] = 0.8
    method: Annotated[Literal["sad", "census"], "cost of a match"] = "sad"
    subpixel: Annotated[bool, "whether to refine"] = True
    horizon_s: Annotated[float, Meta(ge=0.0), "how long a match is kept, s"] = 1.5


@dataclass(frozen=True, slots=True)
class Serial:
    port: Annotated[str, "device of the motor"] = '/dev/"omnid"\t\x7f\n\\ü'
    bauds: Annotated[tuple[Annotated[int, Meta(ge=1)], ...], "rates to try, baud"] = (115200, 9600)


@dataclass(frozen=True, slots=True)
class Motor:
    limit_mps: Annotated[float, Meta(le=0), "speed limit, m/s"] = -1.0
    serial: Serial = field(default_factory=Serial)


@dataclass(frozen=True, slots=True)
class Sample:
    robot: Annotated[str, "name on the bus"] = "robot"
    offset_m: Annotated[tuple[float, float, float], "where the rig is, m"] = (0.0, 1e-5, 1e16)
    topics: Annotated[tuple[str, ...], "topics to record"] = ()
    stereo: Stereo = field(default_factory=Stereo)
    motor: Motor = field(default_factory=Motor)


def written(tmp_path: Path, text: str | bytes) -> Path:
    path = tmp_path / "omnid.toml"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    return path


def refusal(text: str | bytes, *overrides: str) -> str:
    data = text if isinstance(text, bytes) else text.encode()
    with pytest.raises(OmnidError) as caught:
        parse(Sample, data, origin="omnid.toml", overrides=overrides)
    assert "\n" not in str(caught.value) and len(str(caught.value)) < 400
    return str(caught.value)


def test_a_file_changes_what_it_names_and_nothing_else(tmp_path: Path) -> None:
    assert load(Sample) == Sample()
    settings = load(Sample, written(tmp_path, "robot = 'r2'\n[stereo]\nratio = 1\n[motor.serial]\nport = 'x'"))
    assert settings == Sample(robot="r2", stereo=Stereo(ratio=1.0), motor=Motor(serial=Serial("x")))
    assert isinstance(settings.stereo.ratio, float)


@pytest.mark.parametrize(
    ("override", "value"),
    [("robot=7", "7"), ("robot='7'", "7"), ("robot=a=b", "a=b")],
)
def test_an_override_needs_no_quotes(override: str, value: str) -> None:
    assert load(Sample, None, [override]).robot == value
    assert load(Sample, None, ["stereo.method=census"]).stereo.method == "census"


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        (f"{'q' * 300} = 1", "unknown key 'qqq"),
        ("[stereo]\nwindow = 5", "unknown key stereo.window: known are stereo.window_px, "),
        ("stereo = 5", "stereo: expected a section, found 5"),
        ("stereo.window_px = '11'", "stereo.window_px: expected an integer from 3 to 31, found '11'"),
        ("stereo.subpixel = 1", "stereo.subpixel: expected true or false, found 1"),
        ("stereo.horizon_s = inf", "found inf"),
        ("stereo.method = 'ncc'", "stereo.method: expected one of 'sad', 'census', found 'ncc'"),
        ("offset_m = [1, 2]", "offset_m: expected a list of 3 numbers, found [1, 2]"),
        ("motor.serial.bauds = [0]", "expected a list of integers of at least 1, found [0]"),
        (f"topics = {'[' * 20_000}", "expected TOML, found: "),
        (b"robot = '\xff'", "expected TOML in UTF-8, found another byte at offset 9"),
    ],
)
def test_values_that_are_not_as_declared_are_refused(text: str | bytes, expected: str) -> None:
    message = refusal(text)
    assert message.startswith("omnid.toml: ") and expected in message


@pytest.mark.parametrize(
    ("override", "expected"),
    [
        ("stereo.window_px", "expected section.key=value, found no '='"),
        ("stereo=5", "stereo: expected a section, found 5"),
        ("stereo.window_px=5\nrobot='x'", "expected an integer from 3 to 31, found \"5\\nrobot='x'\""),
        ("robot=a\udcff", "robot: expected UTF-8, found 'a\\udcff'"),
    ],
)
def test_a_wrong_override_is_refused(override: str, expected: str) -> None:
    message = refusal("", override)
    assert message.startswith("override ") and expected in message


def test_an_error_names_a_file_that_cannot_be_read(tmp_path: Path) -> None:
    for path in (tmp_path / "missing.toml", tmp_path, Path("a\0b"), written(tmp_path, b"#" * (MAX_FILE_BYTES + 1))):
        with pytest.raises(OmnidError, match=r"settings file .*(omnid|missing|test_|a\\x00b)"):
            load(Sample, path)


@pytest.mark.parametrize(
    "overrides",
    [
        [],
        ["stereo.window_px=31", "stereo.subpixel=false", "motor.serial.port=a\\b", "topics=['a', \"it's\"]"],
    ],
)
def test_a_dump_reads_back_as_the_same_object(tmp_path: Path, overrides: list[str]) -> None:
    settings = load(Sample, None, overrides)
    for text in (dump(settings), dump(settings, ("robot", "stereo.subpixel"))):
        assert load(Sample, written(tmp_path, text)) == settings


def test_a_dump_has_each_key_with_its_range_and_default_and_a_minimal_one_what_differs() -> None:
    settings = load(Sample, None, ["stereo.window_px=5"])
    text = dump(settings)
    assert "[stereo]\n# side of the matching window, px\n# an integer from 3 to 31; default 11\nwindow_px = 5\n" in text
    assert "# a list of 3 numbers; default [0.0, 1e-05, 1e+16]\n" in text
    assert "# one of 'sad', 'census'; default \"sad\"\n" in text
    assert "# a list of integers of at least 1; default [115200, 9600]\n" in text
    assert dump(settings, ()) == "[stereo]\n# side of the matching window, px\nwindow_px = 5\n"
    assert "# whether to refine\n# subpixel = true\n" in dump(settings, ("stereo.subpixel",))


SHIPPED = Path(__file__).parents[2] / "systemd" / "omnid.toml"


def test_the_shipped_configuration_is_the_default() -> None:
    assert load_config(SHIPPED) == Config()
    assert SHIPPED.read_text() == dump(Config(), FIRST_SETTINGS), "run `omnid config --minimal`"
    assert set(FIRST_SETTINGS) <= set(map(".".join, key_paths(Config)))


@pytest.mark.parametrize(
    ("overrides", "matching"),
    [
        ([], "auto"),
        (["odometry.method=paper"], "enhanced"),
        (["odometry.method=paper", "stereo.matching.method=sad"], "sad"),
    ],
)
def test_the_papers_method_works_on_the_enhanced_sad_unless_the_matching_is_set(
    overrides: list[str], matching: str
) -> None:
    assert load_config(None, overrides).stereo_settings().matching.method == matching


@pytest.mark.parametrize(
    ("command", "override"),
    [
        ("run", " log . time=header"),
        ("replay", "cameras.width_px=640"),
    ],
)
def test_an_override_that_the_command_ignores_is_refused(command: str, override: str) -> None:
    config = load_config(None, [override])
    with pytest.raises(OmnidError, match=rf"^override '.*': `omnid {command}` does not use \S+: leave it out$"):
        unused_settings(config, command, [override])


def test_a_replay_names_the_settings_of_the_wheels_which_it_does_not_turn() -> None:
    config = load_config(None, ["motor.port=/dev/ttyUSB0", "controller.arming=automatic"])
    assert unused_settings(config, "replay", []) == [
        "`omnid replay` does not use these settings: controller.arming, motor.port"
    ]
