"""Self-calibration from a drive: odometry with the rig as it is, landmarks, bundle adjustment; and once more."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from os import PathLike
from pathlib import Path

import numpy as np

from calib.fit.least_squares import ROUNDS
from calib.fit.parameters import TIMES, RigParameters
from calib.fit.rig_from_drive import CORRELATED_OBSERVATIONS, DriveAdjustment, adjust_drive, observation_sigma
from calib.fit.rig_uncertainty import drive_uncertainty
from calib.models.camera import Array
from calib.models.ocam import OcamCamera
from calib.rig import Rig, RigCovariance
from calib.rig_file import read_rig
from calib.validation import LineReporter, silent
from drivers.logs.log_reader import AnyCameras, LogCameras
from omnid.calibration.drive_observations import collect
from omnid.calibration.rig_check import check_rig, read_rig_pairs, with_masks
from omnid.core.rig.rig_health import SIGMAS
from omnid.errors import OmnidError

# Distortion terms of omni cameras that are fitted although the file has none: a camera may be tilted below its mirror.
DISTORTION = ("p1", "p2")


@dataclass(frozen=True, slots=True)
class DriveCalibration:
    """The rig that fits the drive."""

    rig: Rig  # with its covariance
    adjustment: DriveAdjustment
    first_sigma_px: float  # of an observation with the rig as it was

    def __str__(self) -> str:
        uncertainty, adjustment = drive_uncertainty(self.rig), self.adjustment
        return (
            f"{len(adjustment.state.T_rig_odom)} keyframes, {len(adjustment.state.points)} landmarks, "
            f"{len(adjustment.observations)} observations; error {self.first_sigma_px:.3f} px before, "
            f"{adjustment.sigma_px:.3f} px after" + (f"; drives: {uncertainty}" if uncertainty else "")
        )

    @property
    def is_better(self) -> bool:
        """True if the log-likelihood has risen by more than one for each parameter (Akaike 1974)."""
        found = self.adjustment
        independent = 2 * len(found.observations) / CORRELATED_OBSERVATIONS
        return independent * math.log(self.first_sigma_px / found.sigma_px) > len(found.parameters.names)


def calibrate_drive(
    log: str | PathLike[str],
    rig: str | PathLike[str] | Rig,
    topics: AnyCameras = (None, None),
    progress: LineReporter = silent,
) -> DriveCalibration:
    """Return the rig that fits a drive best, near the one given; OmnidError or CalibError where it does not suffice.

    topics: of the lower and the upper camera. progress receives one line for each round.
    """
    log, rig = Path(log), rig if isinstance(rig, Rig) else read_rig(Path(rig))
    # 1. Find the rims of the mirrors, and start with tangential terms and times of exposure. Wavefronts are parameters
    #    if boards have shown them: a drive alone shows them as well, but the central cameras that remain measured the
    #    lengths of other drives less well.
    cameras = LogCameras(*topics)
    before = with_masks(log, rig, cameras)
    cameras_before = (before.lower.camera, before.upper.camera)
    waves = any(isinstance(camera, OcamCamera) and any(camera.wavefront) for camera in cameras_before)
    parameters = RigParameters.about(before, DISTORTION, TIMES, waves=waves)
    # 2. Straighten the panoramas until columns match, so that the odometry can track.
    steps = straightened(log, parameters, cameras, progress)
    require_same_rig(parameters, steps)
    # 3. Track and adjust: each round tracks in panoramas of the rig of the one before, the first one in those of a rig
    #    that is hardly known.
    correlated = 1.0 if before.covariance is None else CORRELATED_OBSERVATIONS
    for number in range(1 + ROUNDS):
        state, observations = collect(log, parameters.at(steps), cameras)
        found = adjust_drive(parameters, replace(state, steps=steps), observations, correlated=correlated)
        steps = found.state.steps
        progress(
            f"round {number + 1}: {len(observations)} observations from {len(state.T_rig_odom)} keyframes, error "
            f"{found.sigma_px:.3f} px"
        )
    # 4. Refuse what is another rig.
    require_same_rig(parameters, steps)
    # 5. The length of the baseline by the prior, and the covariance.
    names, units = parameters.rig_names, parameters.units[: len(parameters.rig_names)]
    change = steps[: len(names)] * units
    covariance = found.covariance[: len(names), : len(names)] * np.outer(units, units)
    baseline_m, matrix = parameters.baseline(change, covariance)
    rig = found.rig.with_upper_moved(np.zeros(3), np.zeros(2), baseline_m - before.baseline_m)
    rig = replace(rig, covariance=RigCovariance.of_matrix([*names, "baseline"], matrix))
    return DriveCalibration(rig, found, observation_sigma(before, found))


def straightened(log: Path, parameters: RigParameters, cameras: LogCameras, progress: LineReporter) -> Array:
    """Return steps (P,) to a rig with which columns match, from where tracking works; OmnidError if there is none."""
    rig = parameters.rig
    finding = check_rig(read_rig_pairs(log, rig, cameras), rig).finding
    progress(finding.summary)
    if finding.drift is None:
        raise OmnidError(
            f"calibrate drive: {finding.summary}; are both cameras the ones of this rig, not exchanged, "
            "and is there enough to see?"
        )
    # Errors of a centre, and the motion between two exposures, have the effect of a shifted viewpoint, so only the
    # rotation is a start.
    return parameters.turned(finding.drift.turn)


def require_same_rig(parameters: RigParameters, steps: Array) -> None:
    """Raise OmnidError where steps (P,) lead beyond what another mount or mirror of the same kind differs by."""
    away = np.abs(steps / parameters.nominal_sigmas)[: len(parameters.rig_names)]
    worst = int(np.argmax(away))
    if away[worst] > SIGMAS:
        old, new = parameters.values[worst], (parameters.values + steps * parameters.units)[worst]
        raise OmnidError(
            f"calibrate drive: {parameters.names[worst]} would change from {old:.5g} to {new:.5g}, more than "
            f"{SIGMAS:g} tolerances of a nominal rig; is the rig that of these cameras? Nothing is written for another "
            "one: start from its own or nominal rig"
        )
