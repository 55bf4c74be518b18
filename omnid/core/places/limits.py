"""Limits of the map of places."""

from __future__ import annotations

from dataclasses import dataclass

from omnid.settings import knob


@dataclass(frozen=True, slots=True)
class PlaceLimits:
    """Distance and number of the keyframes that stay."""

    keyframe_m: float = knob(
        0.3, "distance after which a keyframe is kept for the recognition of the place, m", low=0.05, high=10
    )
    keyframe_deg: float = knob(15.0, "turn after which a keyframe is kept, deg", low=1, high=180)
    rate_hz: float = knob(
        5.0, "keyframes a second, at most: each is searched for in the map, which takes some 30 ms", low=0.1, high=100
    )
    max_keyframes: int = knob(
        2000,
        "keyframes kept, of some 35 kB each in memory; more drop those that others are nearest to",
        low=2,
        high=100_000,
    )
