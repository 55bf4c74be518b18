"""Decide by the first keyframes of a log whether a rig that does not fit can be corrected, or is of other cameras.

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
from calib.fit.drive.adjustment import adjust_drive, observation_sigma
from calib.fit.drive.rig_parameters import RigParameters
from calib.fit.drive.rig_prior import prior_information
from calib.models.ocam import has_wavefront
from omnid.calibration.drive_observations import DriveCollector, KeyframeChoice
from omnid.calibration.same_rig import different_rig
from omnid.core.rig.first_pairs import StartFinding
from omnid.core.rig.rig_state import RigState
from omnid.errors import OmnidError
from omnid.messages import OdometryUpdate
from omnid.refinement.estimate import MAX_ERROR_RATIO
from omnid.stages.front_end import FrontEnd
from omnid.stages.geometry import Geometry
from omnid.tracking_state import TrackingState

# Scatter of the columns of matched points: up to 0.2 px with the right rig, with moving shadows and struts 0.4 px;
# other mirrors give 0.3 to 7 px. So it does not decide; it says whether landmarks are examined.
MAX_SPREAD_PX: Final = 0.3
# Few keyframes are enough: parameters that they do not show are held by their tolerances.
KEYFRAMES: Final = 20
LEAST_KEYFRAMES: Final = 5
# Pairs that are read for them: ten seconds of a log at 30 Hz.
MOST_PAIRS: Final = 300
# Distance of keyframes: a short drive gives LEAST_KEYFRAMES within a metre.
KEYFRAME_M, KEYFRAME_RAD = 0.2, np.deg2rad(12)
# Landmarks in view of a keyframe: the examination delays the start of a replay by 2 to 36 s.
LANDMARKS: Final = 150
# Share of the light enough pairs that may have no pose, as in `calibrate drive`; least number of pairs without one,
# because single pairs of a short log must not decide.
MAX_LOST: Final = 0.2
LEAST_LOST: Final = 3


def is_suspicious(finding: StartFinding | None) -> bool:
    """True if the first pairs of a log leave it open whether the rig is the right one."""
    return finding is not None and (finding.state is RigState.DRIFTED or finding.straight.spread_px > MAX_SPREAD_PX)


def other_rig(updates: Iterable[OdometryUpdate], front_end: FrontEnd, finding: StartFinding | None = None) -> str:
    """Return the reason to believe that the rig is of other cameras; empty where there is none, or too little is known.

    updates: poses of a log by the front end, read as far as needed. finding: of the first pairs, if their pixels were
    exposed at once.
    """
    # 1. Keyframes; where poses are lost too often, the existing ones decide.
    start = _FirstPairs(DriveCollector(front_end.geometry, front_end.dense, LANDMARKS))
    with suppress(OmnidError):
        start = _first_keyframes(updates, start, front_end)
    # 2. Their landmarks, or else the number of lost poses.
    return _difference(start.collector, front_end.geometry) or _untracked(start, finding)


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
        return ""  # The drive does not determine the rig.


def _untracked(start: _FirstPairs, finding: StartFinding | None) -> str:
    """Return how badly the log is tracked by a rig whose columns do not match; empty where it is tracked."""
    if finding is None or finding.state is not RigState.DRIFTED or start.lost < max(LEAST_LOST, MAX_LOST * start.pairs):
        return ""
    straight = finding.straight
    return (
        f"no pose is found for {start.lost} of the first {start.pairs} pairs, and the columns of the panoramas do "
        f"not match (off by {straight.offset_px:+.2f} px, spread {straight.spread_px:.2f} px, upper camera turned "
        f"by {straight.turn_deg:.2f} deg)"
    )


def _first_keyframes(updates: Iterable[OdometryUpdate], start: _FirstPairs, front_end: FrontEnd) -> _FirstPairs:
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
                start.collector = DriveCollector(front_end.geometry, front_end.dense, LANDMARKS)
                choice = KeyframeChoice(1, KEYFRAME_M, KEYFRAME_RAD)
        if not lost and not ended and choice.takes(update):
            start.collector.add(update, update.velocity)
    return start
