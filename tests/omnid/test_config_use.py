"""Settings that a command ignores are told; overrides of them are refused."""

from __future__ import annotations

import pytest

from omnid.config import Config, load_config
from omnid.config_use import USED_ONLY_BY, unused_settings
from omnid.errors import OmnidError
from omnid.settings import knob_paths


@pytest.mark.parametrize("path", USED_ONLY_BY)
def test_the_table_of_unused_settings_names_keys_that_exist(path: str) -> None:
    assert any(f"{known}.".startswith(f"{path}.") for known in knob_paths(Config))


@pytest.mark.parametrize(
    ("command", "override"),
    [
        ("run", "graph.depth=3"),
        ("run", " controller.setpoint . velocity_mps=0.0"),
        ("run", "log.reorder_frames=8"),
        ("replay", "cameras.width_px=640"),
        ("replay", "live.cloud_s=1"),
        ("replay", "record.enabled=true"),
    ],
)
def test_refuses_an_override_that_the_command_ignores(command: str, override: str) -> None:
    config = load_config(None, [override])
    with pytest.raises(OmnidError, match=rf"^override '.*': `omnid {command}` does not use \S+: leave it out$"):
        unused_settings(config, command, [override])


def test_warns_in_one_line_of_settings_in_the_file_that_a_replay_ignores() -> None:
    config = load_config(None, ["cameras.width_px=640", "service.stall_timeout_s=5", "record.cloud_points=7"])
    (warning,) = unused_settings(config, "replay", ["record.cloud_points=7"])
    assert warning == "`omnid replay` does not use these settings: cameras.width_px, service.stall_timeout_s"
    assert unused_settings(config, "run", []) == []


def test_the_daemon_refuses_a_setpoint_in_its_configuration() -> None:
    config = load_config(None, ["controller.setpoint.velocity_mps=0.3"])
    with pytest.raises(OmnidError, match="velocity_mps is set, but `omnid run` drives by the setpoints"):
        unused_settings(config, "run", [])
    assert unused_settings(config, "replay", ["controller.setpoint.velocity_mps=0.3"]) == []


@pytest.mark.parametrize("command", ["run", "replay"])
def test_the_defaults_give_no_warning(command: str) -> None:
    assert unused_settings(Config(), command, []) == []
