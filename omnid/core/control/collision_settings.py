"""Settings of the collision monitor."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from omnid.settings import knob

STOP: Final = "stop"
SLOW: Final = "slow"
IGNORE: Final = "ignore"


@dataclass(frozen=True, slots=True)
class CollisionSettings:
    """Outline of the base, distances and times at which it stops and slows down before obstacles."""

    check: bool = knob(True, "slow down and stop before obstacles, whatever the source of the command")
    front_m: float = knob(0.25, "outline of the base: its front, m ahead of the origin of base_link", low=0, high=5)
    rear_m: float = knob(0.25, "outline of the base: its rear, m behind the origin", low=0, high=5)
    half_width_m: float = knob(0.22, "outline of the base: half its width, m", low=0.01, high=5)
    stop_m: float = knob(0.15, "the base stops so far before an obstacle, m", low=0.01, high=5)
    side_m: float = knob(0.04, "free space that it needs at its sides, m", low=0, high=5)
    time_s: float = knob(
        1.5,
        "time to collision that it keeps: its speed is at most the distance to where it must stop, divided by this, s",
        low=0.2,
        high=10,
    )
    slow_m: float = knob(0.5, "an obstacle nearer than this ahead slows it down to slow_mps, m", low=0, high=10)
    slow_side_m: float = knob(0.12, "the same beside its way, m", low=0, high=10)
    slow_mps: float = knob(0.2, "speed near obstacles and into the unknown, m/s", low=0.01, high=10)
    unknown: str = knob(
        STOP,
        "at the end of the floor that was seen, where nothing is known: stop; slow drives on at "
        "slow_mps, also into a plain wall",
        choices=(STOP, SLOW, IGNORE),
    )
    stale: str = knob(
        STOP,
        "when nothing fresh is known of the way: the newest ring of obstacles is older than "
        "stale_s, there is none, or its images are frozen, dark or dirty there",
        choices=(STOP, SLOW, IGNORE),
    )
    stale_s: float = knob(
        0.5,
        "no motion without evidence: the base drives by what its images of so long ago, or "
        "newer ones, showed, whatever the pose says, s",
        low=0.1,
        high=10,
    )
