"""Settings of the obstacle ring."""

from __future__ import annotations

from dataclasses import dataclass

from omnid.errors import OmnidError
from omnid.settings import knob


@dataclass(frozen=True, slots=True)
class RingSettings:
    """Heights, ranges and support of obstacles."""

    floor_m: float = knob(0.0, "height of the floor in the base frame, m; used where the rig states "
                          "the height of its cameras (T_base_rig)", low=-10, high=10)
    heights_m: tuple[float, float] = knob((0.1, 1.7), "heights above the floor between which a point is an obstacle, "
                                          "of the ring and of the map, m: lower ones are floor, higher ones are passed "
                                          "below", low=-10, high=10)
    tilt_deg: float = knob(0.5, "sigma of the tilt of the base against the floor: the margin above the floor grows "
                           "with the range", low=0, high=10)
    max_range_m: float = knob(6.0, "longest range of an obstacle, m", low=0.5, high=50)
    min_points: int = knob(6, "matched points that make an obstacle, within 3 degrees and the noise of the range",
                           low=1, high=1000)
    min_votes: int = knob(2, "pairs of the last four that must have seen an obstacle; 1: no vote", low=1, high=4)
    blind_m: float = knob(0.75, "nearer than this an obstacle is kept until something behind it is seen, because "
                          "stereo cannot see it (stereo.min_range_m)", low=0, high=5)
    memory_s: float = knob(2.0, "an obstacle beyond blind_m is kept for so long while its direction is unknown, s",
                           low=0, high=60)

    free_s: float = knob(60.0, "floor that was seen to be free counts as free for so long where none is seen now, s",
                         low=0, high=3600)

    change_grey: float = knob(8.0, "change of the floor's brightness that shows that something hides it, grey levels; "
                              "more for mirrors that darken towards their rim; 0: not compared, and floor in view "
                              "that stereo does not see again is free for 1.5 s", low=0, high=100)

    def __post_init__(self) -> None:
        """Raise OmnidError unless the heights are in order."""
        if self.heights_m[0] >= self.heights_m[1]:
            raise OmnidError(f"obstacles.ring.heights_m is {list(self.heights_m)}: expected the lower height first")
