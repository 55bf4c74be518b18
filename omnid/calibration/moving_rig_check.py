"""Check of a rig by a log of cameras that are not synchronised: the odometry tells the motion between the exposures."""

from __future__ import annotations

from pathlib import Path

from calib.rig import Rig
from omnid.calibration.drive_observations import Topics, tracked_updates
from omnid.calibration.log_rig_check import PAIRS, open_log
from omnid.config import Config
from omnid.core.rig.rig_check import RigCheck, RigFinding
from omnid.stages.geometry import geometry


def moving_rig_finding(log: Path, rig: Rig, topics: Topics, config: Config) -> RigFinding:
    """Return what at most PAIRS pairs say about the rig, moved to one instant; OmnidError where no pose is found."""
    place, number = geometry(rig, config.panorama), 0
    check = RigCheck(place.cylinder, PAIRS)
    reader = open_log(log, topics, rig)
    try:
        stride = max(1, (reader.pair_estimate() or 0) // PAIRS)
        for update in tracked_updates(reader, place, config, log):
            exposure, seen = update.depth.exposure, update.depth.panoramas
            if exposure is None or not exposure.is_known:
                continue
            if number % stride == 0:
                check.add(seen.lower, seen.upper, seen.visible, exposure)
            number += 1
    finally:
        reader.close()
    return check.finding()
