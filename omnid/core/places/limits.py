"""Limits of the map of places."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

from msgspec import Meta


@dataclass(frozen=True, slots=True)
class PlaceLimits:
    """Distance and number of the keyframes that stay."""

    keyframe_m: Annotated[
        float, Meta(ge=0.05, le=10), "distance after which a keyframe is kept for the recognition of the place, m"
    ] = 0.3
    keyframe_deg: Annotated[float, Meta(ge=1, le=180), "turn after which a keyframe is kept, deg"] = 15.0
    rate_hz: Annotated[
        float,
        Meta(ge=0.1, le=100),
        "keyframes a second, at most: each is searched for in the map, which takes some 30 ms",
    ] = 5.0
    max_keyframes: Annotated[
        int,
        Meta(ge=2, le=100_000),
        "keyframes kept, of some 35 kB each in memory; more drop those that others are nearest to",
    ] = 2000
