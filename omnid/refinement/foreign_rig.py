"""Tell by the first keyframes of a log whether a rig that does not fit can be corrected, or is that of other cameras.

Columns of the panoramas show turned cameras, but hardly the scale of a mirror. The same landmarks from near and from
far show it: a bundle adjustment with the tolerances of a nominal rig, whatever the rig's covariance, finds the rig that
fits, and its distance from the one given decides.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import Final

import numpy as np

from calib.errors import CalibError
from calib.fit.drive_bundle import adjust_drive, observation_sigma
from calib.fit.drive_parameters import RigParameters
from calib.fit.drive_prior import prior_information
from calib.fit.rig_fit import has_wavefront
from omnid.calibration.drive import different_rig
from omnid.calibration.drive_observations import DriveCollector, KeyframeChoice
from omnid.core.rig.start_check import StartFinding
from omnid.errors import OmnidError
from omnid.messages import OdometryUpdate
from omnid.refinement.estimate import MAX_ERROR_RATIO
from omnid.stages.geometry import Geometry
from omnid.tracking_state import TrackingState

# Scatter of the columns of matched points: up to 0.2 px with the right rig, with moving shadows and struts 0.4 px;
# other mirrors give 0.3 to 7 px. So it does not decide, but whether it is worth to look closer.
MAX_SPREAD_PX: Final = 0.3
KEYFRAMES, LEAST_KEYFRAMES, MOST_PAIRS = 20, 12, 300
KEYFRAME_M, KEYFRAME_RAD = 0.2, np.deg2rad(12)
LANDMARKS: Final = 150  # in view of a keyframe


def is_suspicious(finding: StartFinding | None) -> bool:
    """True if the first pairs of a log leave it open whether the rig is the right one."""
    return finding is not None and (finding.condition == "drifted" or finding.straight.spread_px > MAX_SPREAD_PX)


def other_rig(updates: Iterable[OdometryUpdate], place: Geometry) -> str:
    """Return by which the rig is that of other cameras, as far as it takes to know; empty where it is not, or unknown.

    updates: poses of a log with the rig as it is.
    """
    try:
        collector = _first_keyframes(updates, place)
        if collector.keyframes < LEAST_KEYFRAMES:
            return ""
        drives = collector.drives(np.eye(4))
        rig = replace(place.rig, covariance=None)
        waves = any(has_wavefront(mounted.camera) for mounted in (rig.lower, rig.upper))
        parameters = RigParameters.about(rig, waves=waves)
        start = replace(drives.state, steps=np.zeros(len(parameters.names)))
        found = adjust_drive(parameters, start, drives.observations, prior_information(parameters, rig))
        if found.sigma_px > MAX_ERROR_RATIO * observation_sigma(rig, found):
            return ""
        return different_rig(parameters, found.state.steps)
    except (CalibError, OmnidError, np.linalg.LinAlgError):
        return ""  # the drive does not tell


def _first_keyframes(updates: Iterable[OdometryUpdate], place: Geometry) -> DriveCollector:
    """Return the keyframes of the first part of a log that is tracked without a gap and has enough of them."""
    collector, choice, resets = DriveCollector(place, LANDMARKS), KeyframeChoice(1, KEYFRAME_M, KEYFRAME_RAD), 0
    for number, update in enumerate(updates):
        if collector.keyframes >= KEYFRAMES or number >= MOST_PAIRS:
            break
        if update.state is TrackingState.LOST or update.reset_counter != resets:
            collector, choice = DriveCollector(place, LANDMARKS), KeyframeChoice(1, KEYFRAME_M, KEYFRAME_RAD)
            resets = update.reset_counter
        if update.state is not TrackingState.LOST and choice.takes(update):
            collector.add(update, update.velocity)
    return collector
