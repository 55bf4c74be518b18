"""Settings of the obstacle ring."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from omnid.errors import OmnidError
from omnid.settings import knob

LEAST_HEIGHT_M: Final = 0.02  # A plane so little above the floor is the floor, because matching tells no more apart.


@dataclass(frozen=True, slots=True)
class RingSettings:
    """Heights and ranges of obstacles of the ring, and of the range scans of keyframes."""

    floor_m: float = knob(
        0.0,
        "height of the floor in the base frame, m; used where the rig states the height of its cameras (T_base_rig)",
        low=-10,
        high=10,
    )
    heights_m: tuple[float, float] = knob(
        (0.06, 1.7),
        "heights above the floor between which a surface is an "
        "obstacle, of the ring and of the map, m: lower ones are floor, higher ones "
        "are passed below",
        low=-10,
        high=10,
    )
    tilt_deg: float = knob(
        0.5,
        "sigma of the tilt of the base against the floor: in the map the margin above the floor grows with the range",
        low=0,
        high=10,
    )
    max_range_m: float = knob(
        6.0,
        "longest range of an obstacle, m; it must reach beyond the nearest floor that both cameras see",
        low=1.5,
        high=50,
    )
    min_points: int = knob(
        6,
        "matched points that make an obstacle of the map, within 3 degrees and the noise of the range",
        low=1,
        high=1000,
    )

    def __post_init__(self) -> None:
        """Raise OmnidError unless the heights are in order, and the lowest can be told from the floor."""
        if self.heights_m[0] < LEAST_HEIGHT_M:
            raise OmnidError(
                f"obstacles.ring.heights_m is {list(self.heights_m)}: expected a lower height of {LEAST_HEIGHT_M} m or "
                "more, as nothing lower can be told from the floor"
            )
        if self.heights_m[0] >= self.heights_m[1]:
            raise OmnidError(f"obstacles.ring.heights_m is {list(self.heights_m)}: expected the lower height first")
