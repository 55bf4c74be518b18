"""Height and tilt of a rig by the floor that its cameras see: `omnid.calibrate_height`."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from os import PathLike
from pathlib import Path
from typing import Final

from calib import se3
from calib.rig import Rig
from calib.rig_file import read_rig, write_rig
from drivers.logs.log_reader import AnyCameras, LogCameras
from omnid.calibration.rig_check import read_rig_pairs, with_masks
from omnid.config import Config
from omnid.core.floor import MOST_PAIRS, Floor, FloorEstimator
from omnid.errors import OmnidError
from omnid.stages.front_end import FrontEnd
from omnid.stages.geometry import geometry

RULER_SIGMA_M: Final = 0.01  # Standard deviation of a height by ruler: the viewpoint is inside of the mirror.
AGREED_SIGMAS: Final = 3.0
TILT_SIGMAS: Final = 2.0  # Smaller tilts are not written, because they may be errors of the estimate.


@dataclass(frozen=True, slots=True)
class HeightCalibration:
    """The floor below a rig, and the rig with it."""

    before: Rig
    rig: Rig  # T_base_rig with the height, and with the tilt where it is more than the noise; the base is on the floor
    floor: Floor
    pairs: int

    def __str__(self) -> str:
        floor = self.floor
        return (
            f"height of the lower viewpoint {floor.height_m:.3f} m (sigma {floor.sigma_m:.3f}), tilt "
            f"{math.degrees(floor.tilt_rad):.2f} deg (sigma {math.degrees(floor.sigma_rad):.2f}), by the floor in "
            f"{self.pairs} pairs"
        )

    def contradiction(self, ruler_m: float) -> str:
        """Return a warning where a height by ruler differs; empty where both agree."""
        limit_m = AGREED_SIGMAS * math.hypot(self.floor.sigma_m, RULER_SIGMA_M)
        if abs(ruler_m - self.floor.height_m) <= limit_m:
            return ""
        baseline_mm = 1e3 * self.rig.baseline_m * ruler_m / self.floor.height_m
        return (
            f"{ruler_m:.3f} m by ruler, {self.floor.height_m:.3f} m by the floor: they differ by more than "
            f"{limit_m:.3f} m; measure from the floor to the focus of the lower mirror; if that is right, the "
            f"baseline is wrong: {1e3 * self.rig.baseline_m:.1f} mm in the rig, {baseline_mm:.1f} mm would fit"
        )

    def save(self, path: str | PathLike[str]) -> None:
        """Write the rig.toml."""
        write_rig(Path(path), self.rig)


def calibrate_height(
    log: str | PathLike[str], rig: str | PathLike[str] | Rig, topics: AnyCameras = (None, None)
) -> HeightCalibration:
    """Return height and tilt of a rig by pairs spread over a log; OmnidError where they do not show the floor.

    topics: of the lower and the upper camera. The tilt is against z of the base as the rig states it.
    """
    log, rig = Path(log), rig if isinstance(rig, Rig) else read_rig(Path(rig))
    cameras = LogCameras(*topics)
    pairs = read_rig_pairs(log, rig, cameras)
    config = Config()
    front_end = FrontEnd(geometry(with_masks(log, rig, cameras), config.panorama), config)
    view = se3.apply(rig.T_base_rig, rig.lower.viewpoint[None])[0]
    estimator, chosen = FloorEstimator(), pairs[:: -(-len(pairs) // MOST_PAIRS)]
    for pair in chosen:
        depth = front_end.dense.points(front_end.dewarp.process(pair))
        estimator.add(se3.apply(rig.T_base_rig, depth.points) - view, depth.variance_m2)
    floor = estimator.floor
    if floor is None:
        raise OmnidError(
            f"calibrate drive: {log}: the floor is not seen in {len(chosen)} pairs: record a log where "
            "the floor has texture all around (tiles, a carpet, newspapers), or give the measured height "
            "as --height-m to the command that makes the rig"
        )
    return HeightCalibration(rig, on_floor(rig, floor), floor, len(chosen))


def on_floor(rig: Rig, floor: Floor) -> Rig:
    """Return the rig with its base on the floor, levelled where the tilt is more than its noise."""
    if floor.tilt_rad < TILT_SIGMAS * floor.sigma_rad:
        floor = floor._replace(a=0.0, b=0.0)
    view = se3.apply(rig.T_base_rig, rig.lower.viewpoint[None])[0]
    return replace(rig, T_base_rig=floor.T_floor_base(view) @ rig.T_base_rig)
