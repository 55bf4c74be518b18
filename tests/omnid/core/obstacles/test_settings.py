"""Settings of the obstacle ring."""

from __future__ import annotations

import pytest

from omnid.core.obstacles.settings import RingSettings
from omnid.errors import OmnidError


def test_heights_must_be_in_order() -> None:
    with pytest.raises(OmnidError, match="lower height first"):
        RingSettings(heights_m=(1.0, 0.5))


@pytest.mark.parametrize("low_m", [0.0, -0.1, 0.01])
def test_nothing_lower_than_what_matching_resolves_is_an_obstacle(low_m: float) -> None:
    """Else the floor itself would be one, and no floor free."""
    with pytest.raises(OmnidError, match=r"heights_m is .*: expected a lower height of 0.02 m or more"):
        RingSettings(heights_m=(low_m, 1.0))
