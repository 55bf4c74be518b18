"""Settings of the obstacle ring."""

from __future__ import annotations

import pytest

from omnid.core.obstacles.settings import RingSettings
from omnid.errors import OmnidError


def test_heights_must_be_in_order() -> None:
    with pytest.raises(OmnidError, match="lower height first"):
        RingSettings(heights_m=(1.0, 0.5))
