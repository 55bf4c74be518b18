"""The part of a rig on which a map of places depends, and the comparison of two rigs by it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from calib import se3
from calib.panorama import Cylinder
from omnid.core.places.place_map import PlaceMap

Array = NDArray[np.float64]

BASELINE_RATIO: Final = 0.01  # Relative difference of the baselines of one rig, because it may be calibrated again.
# By which the rectified frame may be turned in the rig, for the same reason; by trial on development seeds.
TURN_RAD: Final = 0.02
SHIFT_M: Final = 0.01  # Shift of the rectified frame in the rig, for the same reason; by trial on development seeds.


@dataclass(frozen=True, slots=True, eq=False)
class PlaceRig:
    """Panoramas and baseline, the frames of robot, rig and panoramas, and the hash of the rig's file."""

    cylinder: Cylinder
    baseline_m: float
    T_rig_rect: Array  # (4, 4) of the rectified frame, in which a map is kept
    T_base_rig: Array  # (4, 4)
    rig_hash: str  # hexadecimal

    @property
    def T_base_rect(self) -> Array:
        """Transform (4, 4) from the rectified frame to the robot's base, in whose axes a map is published."""
        return self.T_base_rig @ self.T_rig_rect

    def difference(self, other: PlaceRig) -> str:
        """Return in words why places seen by this rig cannot be compared with those of another; "" where they can."""
        if self.cylinder.width != other.cylinder.width:
            return f"panoramas of {self.cylinder.width} columns, not {other.cylinder.width}"
        if abs(self.baseline_m - other.baseline_m) > BASELINE_RATIO * other.baseline_m:
            return f"a baseline of {self.baseline_m:.4f} m, not {other.baseline_m:.4f} m"
        moved = se3.log(se3.inverse(self.T_rig_rect) @ other.T_rig_rect)
        if np.linalg.norm(moved[3:]) > TURN_RAD or np.linalg.norm(moved[:3]) > SHIFT_M:
            return (
                f"viewpoints that lie otherwise in the rig, by {1e3 * np.linalg.norm(moved[:3]):.0f} mm and "
                f"{np.degrees(np.linalg.norm(moved[3:])):.1f} degrees"
            )
        return ""


def seen_by(places: PlaceMap, rig_of_map: PlaceRig, rig: PlaceRig) -> None:
    """Change the views of a map, in place, to those in the panoramas of a rig without a difference.

    The horizon's row depends on the masks, which may have been found in the images of the run.
    """
    shift = rig.cylinder.row0 - rig_of_map.cylinder.row0
    if not shift:
        return
    for keyframe in places.keyframes.values():
        keyframe.features.views[:, 1:] += np.float32(shift)
