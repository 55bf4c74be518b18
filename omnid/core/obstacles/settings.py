"""Settings of the obstacle scan."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Final

from msgspec import Meta

from omnid.errors import OmnidError

LEAST_HEIGHT_M: Final = 0.02  # Matching cannot distinguish a plane from a floor so little below it.


@dataclass(frozen=True, slots=True)
class ScanSettings:
    """Heights and ranges of obstacles of the scan, and of the range scans of keyframes."""

    floor_m: Annotated[
        float,
        Meta(ge=-10, le=10),
        "height of the floor in the base frame, m; used where the rig states the height of its cameras (T_base_rig)",
    ] = 0.0
    heights_m: Annotated[
        tuple[Annotated[float, Meta(ge=-10, le=10)], Annotated[float, Meta(ge=-10, le=10)]],
        "heights above the floor between which a surface is an "
        "obstacle, of the scan and of the map, m: lower ones are driven over, higher ones "
        "are passed below",
    ] = (0.06, 1.7)
    # sigma of the tilt of the base against the floor: in the map the margin above the floor grows with the range
    tilt_deg: float = 0.5
    max_range_m: Annotated[
        float,
        Meta(ge=1.5, le=50),
        "longest range of an obstacle, m, 4.5 at most in the scan; "
        "it must reach beyond the nearest floor that both cameras see",
    ] = 6.0
    min_points: int = 6  # matched points that make an obstacle of the map, within 3 degrees and the noise of the range

    def __post_init__(self) -> None:
        """Raise OmnidError unless the heights are in order, and the lowest can be told from the floor."""
        if self.heights_m[0] < LEAST_HEIGHT_M:
            raise OmnidError(
                f"obstacles.scan.heights_m is {list(self.heights_m)}: expected a lower height of {LEAST_HEIGHT_M} m or "
                "more, as nothing lower can be told from the floor"
            )
        if self.heights_m[0] >= self.heights_m[1]:
            raise OmnidError(f"obstacles.scan.heights_m is {list(self.heights_m)}: expected the lower height first")
