"""Camera of a pair of panoramas, as one instrument: a view is (column, row in lower, row in upper)."""

from __future__ import annotations

from dataclasses import dataclass

from calib.panorama import Cylinder


@dataclass(frozen=True, slots=True)
class StereoModel:
    """Projection of points into views: the panorama's cylinder, the baseline, and the noise of a tracked corner."""

    cylinder: Cylinder
    baseline_m: float
    sigma_px: float = 0.1  # standard deviation
