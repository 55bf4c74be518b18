"""The configuration that is shipped says what the program does without one."""

from __future__ import annotations

from pathlib import Path

from omnid.config import Config
from omnid.settings import dump, load

SHIPPED = Path(__file__).parents[2] / "systemd" / "omnid.toml"


def test_the_shipped_configuration_is_the_default_with_every_knob() -> None:
    assert load(Config, SHIPPED) == Config()
    assert SHIPPED.read_text() == dump(Config()), "run `omnid config > systemd/omnid.toml`"
