"""Settings of the collision monitor."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Final, Literal

from msgspec import Meta

STOP: Final = "stop"
SLOW: Final = "slow"
IGNORE: Final = "ignore"


@dataclass(frozen=True, slots=True)
class CollisionSettings:
    """Outline of the base, distances and times at which it stops and slows down before obstacles."""

    check: Annotated[bool, "slow down and stop before obstacles, whatever the source of the command"] = True
    front_m: Annotated[
        float, Meta(ge=0, le=5), "outline of the base: its front, m ahead of the origin of base_link"
    ] = 0.25
    rear_m: Annotated[float, Meta(ge=0, le=5), "outline of the base: its rear, m behind the origin"] = 0.25
    half_width_m: Annotated[float, Meta(ge=0.01, le=5), "outline of the base: half its width, m"] = 0.22
    stop_m: Annotated[float, Meta(ge=0.01, le=5), "the base stops so far before an obstacle, m"] = 0.15
    side_m: Annotated[float, Meta(ge=0, le=5), "free space that it needs at its sides, m"] = 0.04
    time_s: Annotated[
        float,
        Meta(ge=0.2, le=10),
        "time to collision that it keeps: its speed is at most the distance to where it must stop, divided by this, s",
    ] = 1.5
    slow_m: Annotated[float, Meta(ge=0, le=10), "an obstacle nearer than this ahead slows it down to slow_mps, m"] = 0.5
    slow_side_m: Annotated[float, Meta(ge=0, le=10), "the same beside its way, m"] = 0.12
    slow_mps: Annotated[float, Meta(ge=0.01, le=10), "speed near obstacles and into the unknown, m/s"] = 0.2
    unknown: Annotated[
        Literal["stop", "slow", "ignore"],
        "at the end of the floor that was seen, where nothing is known: stop; slow drives on at "
        "slow_mps, also into a plain wall",
    ] = STOP
    stale: Annotated[
        Literal["stop", "slow", "ignore"],
        "when nothing fresh is known of the way: the newest ring of obstacles is older than "
        "stale_s, there is none, or its images are frozen, dark or dirty there",
    ] = STOP
    stale_s: Annotated[
        float,
        Meta(ge=0.1, le=10),
        "no motion without evidence: the base drives by what its images of so long ago, or "
        "newer ones, showed, whatever the pose says, s",
    ] = 0.5
