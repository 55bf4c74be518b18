"""Settings of a camera: validation."""

from __future__ import annotations

from typing import Any

import pytest

from drivers.cameras.v4l2_settings import V4l2Settings
from drivers.errors import DriverError


def settings(**fields: Any) -> V4l2Settings:
    return V4l2Settings("/dev/omnid/lower", **fields)


@pytest.mark.parametrize(
    "fields",
    [{"width_px": 0}, {"height_px": 10**6}, {"rate_hz": float("nan")}, {"rate_hz": -1.0}, {"pixel_format": "grey"},
     {"power_line": "55"}, {"auto_exposure": "auto"}, {"buffers": 1}, {"timeout_s": 0.0}, {"retry_s": float("inf")},
     {"gain": -2}, {"controls": ("gain",)}, {"controls": ("gain=high",)}, {"controls": ("=3",)},
     {"auto_gain": "on", "gain": 3}, {"auto_exposure": "on", "exposure_us": 100}, {"auto_focus": "on", "focus": 0}],
)  # fmt: skip
def test_refuses_invalid_settings_in_one_line(fields: dict[str, Any]) -> None:
    with pytest.raises(DriverError, match=r"^camera /dev/omnid/lower: (.*) is .*; give ") as caught:
        settings(**fields)
    assert "\n" not in str(caught.value)


def test_a_device_is_a_path() -> None:
    with pytest.raises(DriverError, match="omnid cameras"):
        V4l2Settings("0")
