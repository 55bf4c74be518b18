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
        int, Meta(ge=2, le=100_000), "keyframes kept; more drop those that others are nearest to"
    ] = 1000
    by_scan: Annotated[
        bool,
        "where no place of a saved map is recognised, localise by the shape of the room: a "
        "particle filter on range scans; another building of the same shape would mislead it",
    ] = False
    max_mb: Annotated[
        float,
        Meta(ge=0.1, le=10_000),
        "memory of the keyframes, MB; the same, and larger features of a map file are read when they are needed",
    ] = 50.0

    @property
    def max_bytes(self) -> int:
        """Memory of the keyframes."""
        return round(1e6 * self.max_mb)
