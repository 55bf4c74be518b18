"""The shipped configuration file is the default one."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from omnid.config import FIRST_SETTINGS, Config, load_config, unused_settings
from omnid.errors import OmnidError
from omnid.settings import dump_minimal, paths_of

SHIPPED = Path(__file__).parents[2] / "systemd" / "omnid.toml"


def test_the_shipped_configuration_is_the_default() -> None:
    assert load_config(SHIPPED) == Config()
    assert SHIPPED.read_text() == dump_minimal(Config(), FIRST_SETTINGS), "run `omnid config --minimal`"
    assert set(FIRST_SETTINGS) <= set(paths_of(Config))


@pytest.mark.parametrize(
    ("overrides", "matching"),
    [
        ([], "auto"),
        (["odometry.method=paper"], "enhanced"),
        (["odometry.method=paper", "stereo.matching.method=sad"], "sad"),
        (["odometry.method=paper", "stereo.matching.method=enhanced"], "enhanced"),
    ],
)
def test_the_papers_method_works_on_the_enhanced_sad_unless_the_matching_is_set(
    overrides: list[str], matching: str
) -> None:
    assert load_config(None, overrides).stereo_settings().matching.method == matching


@pytest.mark.parametrize(
    ("key", "proposed"),
    [
        ("controller.limits.velocity_mpss", "controller.limits.velocity_mps"),
        ("controller.velocity_mps", "controller.limits.velocity_mps"),
        ("mapping.voxel_mm", "mapping.voxel_m"),
    ],
)
def test_a_wrong_key_is_answered_by_a_similar_one(key: str, proposed: str) -> None:
    with pytest.raises(OmnidError, match=re.escape(f"unknown key {key}: did you mean {proposed}?")):
        load_config(None, [f"{key}=1"])


@pytest.mark.parametrize(
    ("command", "override"),
    [
        ("run", " controller.setpoint . velocity_mps=0.0"),
        ("run", "log.rate_hz=8"),
        ("replay", "cameras.width_px=640"),
        ("replay", "live.cloud_s=1"),
        ("replay", "record.enabled=true"),
    ],
)
def test_refuses_an_override_that_the_command_ignores(command: str, override: str) -> None:
    config = load_config(None, [override])
    with pytest.raises(OmnidError, match=rf"^override '.*': `omnid {command}` does not use \S+: leave it out$"):
        unused_settings(config, command, [override])


def test_the_daemon_refuses_a_setpoint_in_its_configuration() -> None:
    config = load_config(None, ["controller.setpoint.velocity_mps=0.3"])
    with pytest.raises(OmnidError, match="velocity_mps is set, but `omnid run` drives by the setpoints"):
        unused_settings(config, "run", [])
    assert unused_settings(config, "replay", ["controller.setpoint.velocity_mps=0.3"]) == []
