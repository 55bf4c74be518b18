"""`omnid config`: files to start from, or to check."""

from __future__ import annotations

from pathlib import Path

import pytest

from omnid.config import Config, load_config
from tests.replay.command import Command


@pytest.fixture
def omnid(capsys: pytest.CaptureFixture[str]) -> Command:
    return Command(capsys)


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
