"""Self-calibration from drives: odometry with the rig as it is, landmarks, bundle adjustment; and once more."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from calib import se3
from calib.fit.drive_bundle import (
    OBSERVATIONS_ALIKE,
    DriveAdjustment,
    adjust_drive,
    adjust_pairs,
    held_out_error,
    observation_sigma,
)
from calib.fit.drive_models import DriveModelScore, best_model, candidate_distortions, drive_structure
from calib.fit.drive_parameters import LINE_TIME, TRANSFORM_NAMES, UPPER_DELAY, RigParameters
from calib.fit.drive_prior import baseline_by_prior, nominal_sigmas, prior_information
from calib.fit.residual_structure import ResidualStructure
from calib.fit.rig_drift import apply_drift
from calib.fit.rig_fit import has_wavefront
from calib.rig import Rig, ShutterTimes
from calib.rig_covariance import RigCovariance
from omnid.calibration.drive_observations import Drives, Topics, collect, observe_pairs
from omnid.calibration.drive_scale import level_turn, rescaled, scale_change, turned_about_lower
from omnid.calibration.log_rig_check import check_rig, open_log, read_rig_pairs
from omnid.config import Config
from omnid.errors import OmnidError
from omnid.stages.geometry import with_rims

Array = NDArray[np.float64]
Report = Callable[[str], None]

ROUNDS = 2  # the second one tracks in panoramas that the first one's rig has straightened
MAX_ROUNDS = 4
SETTLED = 1e-3  # relative change of the scale in a round, below which no further round is needed
PAIR_ROUNDS = 3  # of matching columns, before the first round
START_DISTORTION = ("p1", "p2")  # until the model is chosen
# Larger changes are those of another rig; a nominal rig does not know how its cameras were mounted.
MAX_TURN_RAD, MAX_NOMINAL_TURN_RAD = np.deg2rad(2.8), np.deg2rad(4.5)
MAX_CHANGE_SIGMAS = 4.0  # of a nominal rig's sigmas: intrinsics
TIMES = (UPPER_DELAY, LINE_TIME)
SYNCHRONOUS_S = 3e-3  # largest difference of stamps during which nothing moves that counts
# Times below these are those of synchronous cameras with global shutters.
MIN_TIME, TIME_SIGMAS = {UPPER_DELAY: 0.5, LINE_TIME: 1.0}, 4.0


@dataclass(frozen=True, slots=True)
class DriveCalibration:
    """The rig that fits the drives, beside the one before."""

    before: Rig
    rig: Rig  # with its covariance
    adjustment: DriveAdjustment
    scores: tuple[DriveModelScore, ...]
    first_sigma_px: float  # of an observation with the rig as it was
    scale_change: float  # relative change of lengths against the rig before
    structure: tuple[ResidualStructure, ResidualStructure]  # of the residuals in the lower and the upper image
    level_rad: float  # by which the rig frame was turned into the plane of the drive
    drives: Drives

    @property
    def is_misfit(self) -> bool:
        """True if the model leaves more than the noise explains."""
        return any(structure.is_misfit for structure in self.structure)

    @property
    def times(self) -> list[tuple[str, float]]:
        """Names and values of the rig's times of exposure that differ from none."""
        values = {UPPER_DELAY: 1e3 * self.rig.times.upper_delay_s, LINE_TIME: 1e6 * self.rig.times.line_time_s}
        return [(name, value) for name, value in values.items() if value]

    @property
    def distance_m(self) -> float:
        """The straight distance [m] between the first and the last pair of a single log, with the rig."""
        T_rig_odom = self.adjustment.state.T_rig_odom
        T_first_last = T_rig_odom[0] @ se3.inverse(T_rig_odom[-1]) @ self.drives.T_last
        return float(np.linalg.norm(T_first_last[:3, 3])) * self.rig.baseline_m / self.before.baseline_m


def calibrate_drive(logs: Sequence[Path], rig: Rig, topics: Topics = (None, None),
                    report: Report = lambda _: None) -> DriveCalibration:
    """Return the rig that fits drives best, near the one given; OmnidError or CalibError where they do not tell.

    report receives one line for each round.
    """
    config = Config()
    before = _with_masks(logs[0], rig, topics)
    distortion = START_DISTORTION if len(candidate_distortions(before)) > 1 else ()
    # Boards have shown whether the rays of the cameras meet in one point. A drive alone could tell as well, but the
    # central cameras that remain measured the lengths of other drives less well.
    known = any(has_wavefront(mounted.camera) for mounted in (before.lower, before.upper))
    parameters = RigParameters.about(before, distortion, TIMES, waves=known)
    steps = _straightened(logs[0], parameters, topics, config, report)
    require_same_rig(parameters, steps, tracked=False)
    found, drives = _in_rounds(logs, (parameters, steps), topics, config, report)
    scores = [_score(found, drives, terms, known) for terms in candidate_distortions(before)]
    for score in scores if len(scores) > 1 else ():
        report(str(score))
    terms, times = best_model(scores).distortion, significant_times(found)
    if (terms, times) != (distortion, TIMES):
        parameters = RigParameters.about(_with_times(before, times), terms, times, waves=known)
        found = _adjusted(parameters, _named_steps(parameters, found), drives)
    require_same_rig(parameters, found.state.steps)
    first_sigma = observation_sigma(before, found, drives.fixed)
    return _calibration(before, found, (tuple(scores), first_sigma), drives)


def _in_rounds(logs: Sequence[Path], start: tuple[RigParameters, Array], topics: Topics, config: Config,
               report: Report) -> tuple[DriveAdjustment, Drives]:
    """Track and adjust until lengths change no more: each round tracks in panoramas of the rig of the one before."""
    parameters, steps = start
    rig = parameters.at(steps)
    for number in range(1, MAX_ROUNDS + 1):
        drives = collect(logs, rig, topics, config)
        found = _adjusted(parameters, steps, drives)
        moved = scale_change(found, rig)
        steps, rig = found.state.steps, _with_times(found.rig, significant_times(found))
        report(f"round {number}: {len(drives.observations)} observations from {drives.keyframes} keyframes, error "
               f"{found.sigma_px:.3f} px, lengths {100 * moved:+.3f} %")
        if number >= ROUNDS and abs(moved) < SETTLED:
            break
    return found, drives


def _adjusted(parameters: RigParameters, steps: Array, drives: Drives) -> DriveAdjustment:
    prior = prior_information(parameters, parameters.rig)
    alike = 1.0 if parameters.rig.covariance is None else OBSERVATIONS_ALIKE
    return adjust_drive(parameters, replace(drives.state, steps=steps), drives.observations, prior, drives.fixed,
                        alike=alike)


def _named_steps(parameters: RigParameters, found: DriveAdjustment) -> Array:
    """Return the steps (P,) of other parameters about the same rig that are nearest to an adjustment's."""
    steps = dict(zip(found.parameters.names, found.state.steps.tolist(), strict=True))
    return np.array([steps.get(name, 0.0) for name in parameters.names])


def _score(found: DriveAdjustment, drives: Drives, terms: tuple[str, ...], waves: bool) -> DriveModelScore:
    parameters = RigParameters.about(found.parameters.rig, terms, TIMES, waves=waves)
    prior = prior_information(parameters, parameters.rig)
    return DriveModelScore(terms, held_out_error(parameters, found, prior, drives.fixed))


def _calibration(before: Rig, found: DriveAdjustment, known: tuple[tuple[DriveModelScore, ...], float],
                 drives: Drives) -> DriveCalibration:
    """Return the result: the baseline by the prior, the covariance, and a level frame of a nominal rig."""
    parameters = found.parameters
    names, units = parameters.rig_names, parameters.units[:len(parameters.rig_names)]
    change = found.state.steps[:len(names)] * units
    covariance = found.covariance[:len(names), :len(names)] * np.outer(units, units)
    baseline_m, matrix = baseline_by_prior(before, names, change, covariance)
    rig, level = rescaled(found.rig, baseline_m / before.baseline_m), 0.0
    lengths = scale_change(found, before) + np.log(baseline_m / before.baseline_m)
    if before.covariance is None:
        ends = (*drives.fixed, drives.keyframes)
        longest = int(np.argmax(np.diff(ends)))
        turn = level_turn(rig, found.state.T_rig_odom[ends[longest]:ends[longest + 1]])
        if turn is not None:
            rig, level = turned_about_lower(rig, turn), float(np.linalg.norm(se3.rotation_log(turn)))
    rig = replace(rig, covariance=RigCovariance.of_matrix([*names, "baseline"], matrix))
    scores, first_sigma = known
    return DriveCalibration(before, rig, found, scores, first_sigma, lengths, drive_structure(found), level, drives)


def _with_times(rig: Rig, kept: tuple[str, ...]) -> Rig:
    """Return the rig without the times of exposure that are not kept."""
    times = ShutterTimes(rig.times.upper_delay_s if UPPER_DELAY in kept else 0.0,
                         rig.times.line_time_s if LINE_TIME in kept else 0.0)
    return replace(rig, times=times)


def significant_times(found: DriveAdjustment) -> tuple[str, ...]:
    """Return the names of the times of exposure that differ from none."""
    names, values = found.parameters.names, found.parameters.values + found.state.steps * found.parameters.units
    sigmas = found.sigmas * found.parameters.units
    return tuple(name for name, value, sigma in zip(names, values, sigmas, strict=True)
                 if name in TIMES and abs(value) > max(MIN_TIME[name], TIME_SIGMAS * sigma))


def require_same_rig(parameters: RigParameters, steps: Array, *, tracked: bool = True) -> None:
    """Raise OmnidError where the drive asks for another rig than the one given; tracked: as of `different_rig`."""
    reason = different_rig(parameters, steps, tracked=tracked)
    if reason:
        raise OmnidError(f"calibrate drive: {reason}; is the rig that of these cameras? Nothing is written for another "
                         "one: start from its own or nominal rig")


def different_rig(parameters: RigParameters, steps: Array, *, tracked: bool = True) -> str:
    """Return by which a rig after steps (P,) is not the one of the parameters; empty where it may be.

    tracked: False before the motion is known: an upper camera that is exposed late then looks as if it stood aside.
    """
    first = len(parameters.rig_names) - len(TRANSFORM_NAMES)
    change = (steps * parameters.units)[first:len(parameters.rig_names)]
    turn, lean = float(np.linalg.norm(change[:3])), float(np.linalg.norm(change[3:])) if tracked else 0.0
    limit = MAX_NOMINAL_TURN_RAD if is_nominal(parameters.rig) else MAX_TURN_RAD
    if max(turn, lean) > limit:
        return (f"the upper camera stands {np.rad2deg(turn):.1f} deg turned and {np.rad2deg(lean):.1f} deg aside of "
                f"the rig's file, expected {np.rad2deg(limit):.1f} deg at most")
    away = np.abs(steps / nominal_sigmas(parameters))[:first]
    worst = int(np.argmax(away))
    if away[worst] <= MAX_CHANGE_SIGMAS:
        return ""
    old, new = parameters.values[worst], (parameters.values + steps * parameters.units)[worst]
    return (f"{parameters.names[worst]} would change from {old:.5g} to {new:.5g}, more than another calibration of the "
            "same camera and mirror")


def is_nominal(rig: Rig) -> bool:
    """True if a rig was not measured: no covariance, and one camera exactly above the other without any rotation."""
    T = rig.upper.T_cam_rig @ se3.inverse(rig.lower.T_cam_rig)
    straight = np.allclose(T[:3, :3], np.eye(3), atol=1e-9) and np.allclose(T[:2, 3], 0, atol=1e-9)
    return rig.covariance is None and bool(straight)


def _with_masks(log: Path, rig: Rig, topics: Topics) -> Rig:
    reader = open_log(log, topics, rig)
    try:
        return with_rims(rig, reader.frames())
    finally:
        reader.close()


def _straightened(log: Path, parameters: RigParameters, topics: Topics, config: Config, report: Report) -> Array:
    """Return steps (P,) to a rig with which columns match, from where tracking works; OmnidError if there is none."""
    rig = parameters.rig
    reader = open_log(log, topics, rig)
    try:
        pairs = read_rig_pairs(reader, rig)
    finally:
        reader.close()
    finding = check_rig(pairs, rig, config.panorama).finding
    report(finding.summary)
    if finding.drift is None:
        raise OmnidError(f"calibrate drive: {finding.summary}; are both cameras the ones of this rig, not exchanged, "
                         "and is there enough to see?")
    # Errors of a centre look like a shifted viewpoint, which is none: only the rotation is a start.
    steps = parameters.transform_steps(apply_drift(rig, replace(finding.drift, shift=np.zeros(2))))
    prior = prior_information(parameters, rig)
    if float(np.median([abs(pair.skew_s) for pair in pairs])) > SYNCHRONOUS_S:
        return steps  # the motion between the exposures would look like errors of the centres
    for _ in range(PAIR_ROUNDS):
        state, observations = observe_pairs(pairs, parameters.at(steps), config)
        steps = adjust_pairs(parameters, replace(state, steps=steps), observations, prior)
    finding = check_rig(pairs, parameters.at(steps), config.panorama).finding
    report(finding.summary)
    return steps
