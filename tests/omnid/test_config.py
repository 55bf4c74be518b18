"""The shipped configuration file is the default one."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from omnid.config import Config, load_config
from omnid.errors import OmnidError
from omnid.settings_dump import dump

SHIPPED = Path(__file__).parents[2] / "systemd" / "omnid.toml"


def test_the_shipped_configuration_is_the_default_with_every_knob() -> None:
    assert load_config(SHIPPED) == Config()
    assert SHIPPED.read_text() == dump(Config()), "run `omnid config > systemd/omnid.toml`"


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
        ("controller.max_velocity", "did you mean controller.limits.velocity_mps or "),
        ("motor.wheel_base_mm", "did you mean motor.drive.track_m?"),
        ("wheel_separation", "did you mean motor.drive.track_m?"),
        ("mapping.voxel_mm", "did you mean mapping.voxel_m?"),
    ],
)
def test_a_wrong_key_is_answered_by_keys_of_its_own_section(key: str, proposed: str) -> None:
    with pytest.raises(OmnidError, match=re.escape(f"unknown key {key}: {proposed}")):
        load_config(None, [f"{key}=1"])


def test_one_override_needs_no_list() -> None:
    assert load_config(overrides="motor.rate_hz=31") == load_config(overrides=["motor.rate_hz=31"]) != Config()
