"""Self-calibration from drives: odometry with the rig as it is, landmarks, bundle adjustment; and once more."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from os import PathLike
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from calib import se3
from calib.fit.drive.adjustment import (
    OBSERVATIONS_ALIKE,
    DriveAdjustment,
    adjust_drive,
    held_out_error,
    observation_sigma,
)
from calib.fit.drive.camera_terms import DriveModelScore, best_model, candidate_distortions, drive_structure
from calib.fit.drive.rig_parameters import LINE_TIME, UPPER_DELAY, RigParameters
from calib.fit.drive.rig_prior import baseline_by_prior, prior_information
from calib.fit.residual_structure import ResidualStructure
from calib.fit.rig_uncertainty import drive_uncertainty
from calib.models.ocam import has_wavefront
from calib.rig import Rig, ShutterTimes
from calib.rig_covariance import RigCovariance
from calib.rig_file import read_rig
from drivers.logs.log_reader import AnyCameras, LogCameras
from omnid.calibration.board_search import Progress, silent
from omnid.calibration.drive_observations import Drives, collect
from omnid.calibration.drive_scale import level_turn, rescaled, scale_change, turned_about_lower
from omnid.calibration.drive_start import straightened, with_masks
from omnid.calibration.images import SIDES
from omnid.calibration.same_rig import require_same_rig
from omnid.config import Config
from omnid.errors import OmnidError

Array = NDArray[np.float64]

# Rounds at least and at most: the second one tracks in panoramas that the rig of the first one has straightened. More
# rounds follow while lengths still change.
ROUNDS, MAX_ROUNDS = 2, 4
# Relative change of lengths in a round below which no further round is needed: a third of the scale's sigma after a
# drive (0.3 % in rendered rooms).
SETTLED = 1e-3
# Least length of a known distance, so that an error of a centimetre at its ends is negligible. A
# baseline that would change by more than MAX_SCALE_CHANGE shows a mistake, because a ruler measures it better.
MIN_DISTANCE_M, MAX_SCALE_CHANGE = 1.0, 0.05
# Error of the landmarks with the new rig, in parts of that with the old one. Free parameters always lower the error a
# little, so a smaller gain does not show a better rig.
SMALL_GAIN = 0.95
# Distortion terms until the model is chosen: those of a camera tilted below its mirror.
START_DISTORTION = ("p1", "p2")
TIMES = (UPPER_DELAY, LINE_TIME)
# Times below these are those of synchronous cameras with global shutters; so are times within four of their sigmas.
MIN_TIME, TIME_SIGMAS = {UPPER_DELAY: 0.5, LINE_TIME: 1.0}, 4.0


@dataclass(frozen=True, slots=True)
class DriveCalibration:
    """The rig that fits the drives, and the one before."""

    before: Rig
    rig: Rig  # with its covariance
    adjustment: DriveAdjustment
    scores: tuple[DriveModelScore, ...]
    first_sigma_px: float  # of an observation with the rig as it was
    scale_change: float  # relative change of lengths against the rig before
    structure: tuple[ResidualStructure, ResidualStructure]  # of the residuals in the lower and the upper image
    level_rad: float  # by which the rig frame was turned into the plane of the drive
    drives: Drives

    def __str__(self) -> str:
        uncertainty = drive_uncertainty(self.rig)
        return (
            f"{'MISFIT: ' if self.is_misfit else ''}error {self.first_sigma_px:.3f} px before, "
            f"{self.adjustment.sigma_px:.3f} px after, {self.drives.keyframes} keyframes, "
            f"{len(self.adjustment.state.points)} landmarks, lengths change by {100 * self.scale_change:+.3f} %"
            + (f"; drives: {uncertainty}" if uncertainty else "")
        )

    def lines(self) -> list[str]:
        """Return the result as lines: errors before and after, change of lengths, each parameter with its sigma."""
        adjustment, parameters = self.adjustment, self.adjustment.parameters
        uncertainty = drive_uncertainty(self.rig)
        lines = [
            f"{'MISFIT: the residuals are not noise. ' if self.is_misfit else ''}{self.drives.keyframes} keyframes, "
            f"{len(adjustment.state.points)} landmarks, {len(adjustment.observations)} observations; error "
            f"{self.first_sigma_px:.3f} px before, {adjustment.sigma_px:.3f} px after",
            *(f"{side}: {structure}" for side, structure in zip(SIDES, self.structure, strict=True)),
            f"lengths change by {100 * self.scale_change:+.3f} %" + (f"; {uncertainty}" if uncertainty else ""),
            f"{'parameter':<14}{'before':>14}{'after':>14}{'sigma':>11}",
        ]
        after = parameters.values + adjustment.state.steps * parameters.units
        sigmas = adjustment.sigmas * parameters.units
        rows = zip(parameters.names, parameters.values, after, sigmas, adjustment.seen.tolist(), strict=True)
        for name, old, new, sigma, seen in rows:
            unseen = "" if seen else "  the drive does not show it"
            lines.append(f"{name:<14}{old:>14.5f}{new:>14.5f}{sigma:>11.5f}{unseen}")
        if not np.all(adjustment.seen):
            lines.append("parameters that the drive does not show stay near their start")
        if self.times:
            times = ", ".join(f"{name} {value:.3g}" for name, value in self.times)
            lines.append(f"times of exposure: {times}: in the table [times] of the file, where runs read them")
        if self.level_rad:
            lines.append(
                f"the rig frame was turned by {np.rad2deg(self.level_rad):.2f} deg, so that the drive lies in "
                "the x-y plane of the base"
            )
        return lines

    @property
    def is_better(self) -> bool:
        """True if the landmarks fit better than with the rig before by more than further parameters always bring."""
        return self.adjustment.sigma_px <= SMALL_GAIN * self.first_sigma_px

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

    def at_distance(self, distance_m: float) -> Rig:
        """Return the rig with the baseline by a known distance from the first to the last pair; OmnidError if odd."""
        if self.distance_m < MIN_DISTANCE_M:
            raise OmnidError(
                f"--distance-m: the log ends {self.distance_m:.2f} m from its beginning, expected "
                f"{MIN_DISTANCE_M:.0f} m at least; measure the distance between two stops farther apart"
            )
        ratio = distance_m / self.distance_m
        if abs(ratio - 1) > MAX_SCALE_CHANGE:
            raise OmnidError(
                f"--distance-m {distance_m:g}: the log ends {self.distance_m:.3f} m from its beginning by "
                f"the baseline of {1e3 * self.rig.baseline_m:.1f} mm; which of the two is wrong?"
            )
        rig, covariance = rescaled(self.rig, ratio), self.rig.covariance
        return replace(rig, covariance=covariance and covariance.select(covariance.names[:-1]))


def calibrate_drive(
    logs: Sequence[str | PathLike[str]],
    rig: str | PathLike[str] | Rig,
    topics: AnyCameras = (None, None),
    progress: Progress = silent,
) -> DriveCalibration:
    """Return the rig that fits drives best, near the one given; OmnidError or CalibError where they do not suffice.

    logs: one name of a file, or several. topics: of the lower and the upper camera. progress receives one line for each
    round.
    """
    paths = [Path(log) for log in ([logs] if isinstance(logs, str) else logs)]
    rig, config = rig if isinstance(rig, Rig) else read_rig(Path(rig)), Config()
    # 1. Find the rims of the mirrors, and start with tangential terms and times of exposure. Wavefronts are parameters
    #    if boards have shown them: a drive alone shows them as well, but the central cameras that remain measured the
    #    lengths of other drives less well.
    cameras = LogCameras(*topics)
    before = with_masks(paths[0], rig, cameras)
    distortion = START_DISTORTION if len(candidate_distortions(before)) > 1 else ()
    waves = any(has_wavefront(mounted.camera) for mounted in (before.lower, before.upper))
    parameters = RigParameters.about(before, distortion, TIMES, waves=waves)
    # 2. Straighten the panoramas until columns match, so that the odometry can track.
    steps = straightened(paths[0], parameters, cameras, config, progress)
    require_same_rig(parameters, steps, tracked=False)
    # 3. Track and adjust in rounds, until lengths change no more.
    found, drives = _in_rounds(paths, parameters, steps, cameras, config, progress)
    # 4. Choose the distortion terms by landmarks held out, and the times of exposure that differ from none.
    scores = tuple(_score(found, drives, terms, waves) for terms in candidate_distortions(before))
    for score in scores if len(scores) > 1 else ():
        progress(str(score))
    terms, times = best_model(scores).distortion, significant_times(found)
    # 5. Adjust once more with the chosen ones, and refuse what is another rig.
    if (terms, times) != (distortion, TIMES):
        parameters = RigParameters.about(_with_times(before, times), terms, times, waves=waves)
        found = _adjusted(parameters, _named_steps(parameters, found), drives)
    require_same_rig(parameters, found.state.steps)
    # 6. The length of the baseline by the prior, the covariance, and a level frame of a nominal rig.
    adjusted, level_rad = _finished_rig(before, found, drives)
    return DriveCalibration(
        before,
        adjusted,
        found,
        scores,
        observation_sigma(before, found, drives.fixed),
        # By the rays of the adjustment, and by the length of the baseline.
        scale_change(found, before) + float(np.log(adjusted.baseline_m / before.baseline_m)),
        drive_structure(found),
        level_rad,
        drives,
    )


def _in_rounds(
    logs: Sequence[Path],
    parameters: RigParameters,
    steps: Array,
    cameras: LogCameras,
    config: Config,
    progress: Progress,
) -> tuple[DriveAdjustment, Drives]:
    """Track and adjust until lengths change no more: each round tracks in panoramas of the rig of the one before.

    steps (P,): of the parameters, to start from.
    """
    rig = parameters.at(steps)
    for number in range(1, MAX_ROUNDS + 1):
        drives = collect(logs, rig, cameras, config)
        found = _adjusted(parameters, steps, drives)
        moved = scale_change(found, rig)
        steps, rig = found.state.steps, _with_times(found.rig, significant_times(found))
        progress(
            f"round {number}: {len(drives.observations)} observations from {drives.keyframes} keyframes, error "
            f"{found.sigma_px:.3f} px, lengths {100 * moved:+.3f} %"
        )
        if number >= ROUNDS and abs(moved) < SETTLED:
            break
    return found, drives


def _adjusted(parameters: RigParameters, steps: Array, drives: Drives) -> DriveAdjustment:
    prior = prior_information(parameters, parameters.rig)
    alike = 1.0 if parameters.rig.covariance is None else OBSERVATIONS_ALIKE
    return adjust_drive(
        parameters, replace(drives.state, steps=steps), drives.observations, prior, drives.fixed, alike=alike
    )


def _named_steps(parameters: RigParameters, found: DriveAdjustment) -> Array:
    """Return the steps (P,) of other parameters about the same rig that are nearest to an adjustment's."""
    steps = dict(zip(found.parameters.names, found.state.steps.tolist(), strict=True))
    return np.array([steps.get(name, 0.0) for name in parameters.names])


def _score(found: DriveAdjustment, drives: Drives, terms: tuple[str, ...], waves: bool) -> DriveModelScore:
    parameters = RigParameters.about(found.parameters.rig, terms, TIMES, waves=waves)
    prior = prior_information(parameters, parameters.rig)
    return DriveModelScore(terms, held_out_error(parameters, found, prior, drives.fixed))


def _finished_rig(before: Rig, found: DriveAdjustment, drives: Drives) -> tuple[Rig, float]:
    """Return the rig with baseline and covariance, and the angle [rad] by which a nominal rig's frame was levelled."""
    parameters = found.parameters
    names, units = parameters.rig_names, parameters.units[: len(parameters.rig_names)]
    change = found.state.steps[: len(names)] * units
    covariance = found.covariance[: len(names), : len(names)] * np.outer(units, units)
    baseline_m, matrix = baseline_by_prior(before, names, change, covariance)
    rig, level_rad = rescaled(found.rig, baseline_m / before.baseline_m), 0.0
    if before.covariance is None:
        ends = (*drives.fixed, drives.keyframes)
        longest = int(np.argmax(np.diff(ends)))
        turn = level_turn(rig, found.state.T_rig_odom[ends[longest] : ends[longest + 1]])
        if turn is not None:
            rig, level_rad = turned_about_lower(rig, turn), float(np.linalg.norm(se3.rotation_log(turn)))
    return replace(rig, covariance=RigCovariance.of_matrix([*names, "baseline"], matrix)), level_rad


def _with_times(rig: Rig, kept: tuple[str, ...]) -> Rig:
    """Return the rig without the times of exposure that are not kept."""
    times = ShutterTimes(
        rig.times.upper_delay_s if UPPER_DELAY in kept else 0.0, rig.times.line_time_s if LINE_TIME in kept else 0.0
    )
    return replace(rig, times=times)


def significant_times(found: DriveAdjustment) -> tuple[str, ...]:
    """Return the names of the times of exposure that differ from none."""
    names, values = found.parameters.names, found.parameters.values + found.state.steps * found.parameters.units
    sigmas = found.sigmas * found.parameters.units
    return tuple(
        name
        for name, value, sigma in zip(names, values, sigmas, strict=True)
        if name in TIMES and abs(value) > max(MIN_TIME[name], TIME_SIGMAS * sigma)
    )
