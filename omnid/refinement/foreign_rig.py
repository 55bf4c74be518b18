"""Tell by the first keyframes of a log whether a rig that does not fit can be corrected, or is that of other cameras.

Columns of the panoramas show turned cameras, but hardly the scale of a mirror. The same landmarks from near and from
far show it: a bundle adjustment with the tolerances of a nominal rig, whatever the rig's covariance, finds the rig that
fits, and its distance from the one given decides. Where the rig is so wrong that poses are lost, and its columns do not
match, no adjustment is needed.
"""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass, replace
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
# Few keyframes are enough: the tolerances hold what they do not show, so that too few of them change nothing.
KEYFRAMES, LEAST_KEYFRAMES, MOST_PAIRS = 20, 5, 300
KEYFRAME_M, KEYFRAME_RAD = 0.2, np.deg2rad(12)
LANDMARKS: Final = 150  # in view of a keyframe
# Pairs without a pose, in parts of those that are light enough, and their least number.
MAX_LOST, LEAST_LOST = 0.2, 3


def is_suspicious(finding: StartFinding | None) -> bool:
    """True if the first pairs of a log leave it open whether the rig is the right one."""
    return finding is not None and (finding.condition == "drifted" or finding.straight.spread_px > MAX_SPREAD_PX)


def other_rig(updates: Iterable[OdometryUpdate], place: Geometry, finding: StartFinding | None = None) -> str:
    """Return by which the rig is that of other cameras, as far as it takes to know; empty where it is not, or unknown.

    updates: poses of a log with the rig as it is. finding: of its first pairs, if these were seen at one time.
    """
    start = _FirstPairs(DriveCollector(place, LANDMARKS))
    with suppress(OmnidError):  # the poses are lost too often: those that there are tell why
        start = _first_keyframes(updates, start, place)
    return _difference(start.collector, place) or _untracked(start, finding)


@dataclass(slots=True)
class _FirstPairs:
    """Keyframes of the first part of a log, and how many of its pairs have no pose."""

    collector: DriveCollector
    pairs: int = 0  # that are light enough
    lost: int = 0


def _difference(collector: DriveCollector, place: Geometry) -> str:
    """Return what a bundle adjustment of keyframes changes that calibrations of one rig have in common."""
    if collector.keyframes < LEAST_KEYFRAMES:
        return ""
    try:
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


def _untracked(start: _FirstPairs, finding: StartFinding | None) -> str:
    """Return how badly the log is tracked by a rig whose columns do not match; empty where it is tracked."""
    if finding is None or finding.condition != "drifted" or start.lost < max(LEAST_LOST, MAX_LOST * start.pairs):
        return ""
    straight = finding.straight
    return (f"no pose is found for {start.lost} of the first {start.pairs} pairs, and the columns of the panoramas do "
            f"not match (off by {straight.offset_px:+.2f} px, spread {straight.spread_px:.2f} px, upper camera turned "
            f"by {straight.turn_deg:.2f} deg)")


def _first_keyframes(updates: Iterable[OdometryUpdate], start: _FirstPairs, place: Geometry) -> _FirstPairs:
    """Return the start of a log, with the keyframes of its first part that is tracked without a gap."""
    choice, resets, ended = KeyframeChoice(1, KEYFRAME_M, KEYFRAME_RAD), 0, False
    for number, update in enumerate(updates):
        if start.collector.keyframes >= KEYFRAMES or number >= MOST_PAIRS:
            break
        lost = update.state is TrackingState.LOST
        if not update.light.is_too_dark:
            start.pairs, start.lost = start.pairs + 1, start.lost + lost
        if lost or update.reset_counter != resets:
            resets, ended = update.reset_counter, start.collector.keyframes >= LEAST_KEYFRAMES
            if not ended:
                start.collector, choice = DriveCollector(place, LANDMARKS), KeyframeChoice(1, KEYFRAME_M, KEYFRAME_RAD)
        if not lost and not ended and choice.takes(update):
            start.collector.add(update, update.velocity)
    return start
