"""The floor of a stage: as the rig states it, else as found in the points of its pairs."""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from calib import se3
from calib.rig import Rig
from omnid.core.floor import Floor, FloorEstimator
from omnid.messages import DensePoints

Array = NDArray[np.float64]

ADVICE: Final = "state it by `omnid calibrate drive LOG --only height --rig rig.toml -o rig.toml`"


class CameraFloor:
    """The floor below the cameras; each stage has its own, fed with the depths that it uses: threads change nothing."""

    def __init__(self, rig: Rig, floor_m: float) -> None:
        """floor_m: height of the floor in the base frame (obstacles.ring.floor_m)."""
        self._T_base_rig = rig.T_base_rig
        self.view = se3.apply(rig.T_base_rig, rig.lower.viewpoint[None])[0]  # (3,) in the base frame
        height_m = rig.height_m(floor_m)
        self.stated = None if height_m is None else Floor(height_m)
        self._estimator = FloorEstimator()

    @property
    def floor(self) -> Floor | None:
        """The floor as it is known now; None: nothing may be called free."""
        return self.stated or self._estimator.floor

    @property
    def wants_points(self) -> bool:
        """True as long as `add` may change the floor."""
        return self.stated is None and not self._estimator.is_final

    def add(self, depth: DensePoints) -> None:
        """Search for the floor in the points of a pair, where the rig does not state its height."""
        if self.wants_points:
            points = se3.apply(self._T_base_rig, depth.points) - self.view
            self._estimator.add(points, depth.variance_m2)

    def T_floor_rig(self, floor: Floor) -> Array:
        """Return the transform (4, 4) from the rig to the level frame of the base, with the floor at z = 0."""
        return np.asarray(floor.T_floor_base(self.view) @ self._T_base_rig)

    def summary(self) -> str:
        """Return one sentence about a height that the rig does not state; empty where it does."""
        if self.stated is not None:
            return ""
        floor = self._estimator.floor
        if floor is None:
            return (
                "the rig does not state the height of the cameras, and the images do not show the floor: map, grid "
                f"and obstacles call nothing free; {ADVICE}"
            )
        return (
            f"the rig does not state the height of the cameras: the images show the floor {floor.height_m:.2f} m "
            f"(sigma {floor.sigma_m:.2f}) below the lower one, tilted by {math.degrees(floor.tilt_rad):.1f} deg "
            f"(sigma {math.degrees(floor.sigma_rad):.1f}), which is used; {ADVICE}"
        )
