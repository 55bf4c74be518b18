"""The shipped configuration file is the default one, and the table of renamed keys leads to keys that exist."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from omnid.config import RENAMED, Config, load_config
from omnid.errors import OmnidError
from omnid.settings import dump

SHIPPED = Path(__file__).parents[2] / "systemd" / "omnid.toml"


def test_the_shipped_configuration_is_the_default_with_every_knob() -> None:
    assert load_config(SHIPPED) == Config()
    assert SHIPPED.read_text() == dump(Config()), "run `omnid config > systemd/omnid.toml`"


@pytest.mark.parametrize("old", RENAMED)
def test_refuses_every_renamed_key_with_a_name_that_exists(old: str) -> None:
    with pytest.raises(OmnidError, match=re.escape(f"override '{old}=1': {old} ")) as caught:
        load_config(None, [f"{old}=1"])
    assert "which has no" not in str(caught.value)
    if " " not in RENAMED[old]:
        assert str(caught.value).endswith(f"is now called {RENAMED[old]}")
