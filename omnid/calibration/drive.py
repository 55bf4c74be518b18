"""Self-calibration from drives: odometry with the rig as it is, landmarks, bundle adjustment; and once more."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from calib import se3
from calib.fit.drive_bundle import (
    DriveAdjustment,
    DriveObservations,
    DriveState,
    RigParameters,
    adjust_drive,
    observation_sigma,
)
from calib.fit.rig_drift import apply_drift
from calib.rig import Rig
from drivers.logs.mcap_reader import LogReader
from omnid.calibration.log_rig_check import check_rig, open_log, read_rig_pairs
from omnid.config import Config
from omnid.core.rig.drive_landmarks import DriveLandmarks, View, image_pixels
from omnid.core.stereo.triangulation import common_perpendicular
from omnid.errors import OmnidError
from omnid.messages import OdometryUpdate
from omnid.stages.dewarp import Dewarp
from omnid.stages.geometry import Geometry, geometry, with_rims
from omnid.stages.odometry import OdometryStage
from omnid.stages.rig_gate import RigGate
from omnid.stages.stereo import Stereo
from omnid.stages.synchronise import Synchronise
from omnid.tracking_state import TrackingState

Array = NDArray[np.float64]
Topics = tuple[str | None, str | None]

ROUNDS = 2  # the second one tracks in panoramas that the first one's rig has straightened
MAX_ROUNDS = 4
SETTLED = 1e-3  # relative change of the scale in a round, below which no further round is needed
KEYFRAME_M, KEYFRAME_RAD = 0.12, np.deg2rad(8)
MAX_KEYFRAMES = 80  # of all drives: keyframes are farther apart on long ones
MIN_KEYFRAMES = 15
MIN_TURN_RAD = np.deg2rad(60)  # of all drives together; on a straight line tilt and direction of motion are one
MAX_LOST = 0.2  # share of the pairs
DRIFT_ROUNDS = 3
NOISE_PX = 0.1
GRADIENT_STEP = 0.01
# What is believed of a rig before the drive, as far as its file does not say it better: a nominal rig.
XI_SIGMA, FOCAL_SIGMA, CENTRE_SIGMA_PX, DISTORTION_SIGMA_PX = 0.02, 0.02, 3.0, 1.0
TURN_SIGMA_RAD, DIRECTION_SIGMA_RAD = np.deg2rad(1.5), np.deg2rad(2.0)


@dataclass(frozen=True, slots=True)
class DriveCalibration:
    """The rig that fits the drives, beside the one before."""

    before: Rig
    adjustment: DriveAdjustment
    first_sigma_px: float  # of an observation with the rig as it was
    scale_change: float  # relative change of lengths against the rig before
    scale_sigma: float  # relative standard deviation of lengths that the rig's remaining errors leave
    keyframes: int

    @property
    def rig(self) -> Rig:
        """The adjusted rig."""
        return self.adjustment.rig


def calibrate_drive(logs: Sequence[Path], rig: Rig, topics: Topics = (None, None),
                    report: Callable[[str], None] = lambda _: None) -> DriveCalibration:
    """Return the rig that fits drives best, near the one given; OmnidError or CalibError where they do not tell.

    report receives one line for each round.
    """
    config = Config()
    rig = _with_masks(logs[0], rig, topics)
    start, change, first_sigma = rig, 0.0, np.nan
    parameters = RigParameters.about(_straightened(logs, rig, topics, config, report))
    prior, steps = _prior(parameters), np.zeros(len(parameters.names))
    for number in range(1, MAX_ROUNDS + 1):
        state, observations, fixed = _collect(logs, parameters.at(steps), topics, config)
        found = adjust_drive(parameters, replace(state, steps=steps), observations, prior, fixed)
        if number == 1:
            first_sigma = observation_sigma(start, found, fixed)
        gradient = scale_gradient(found)
        moved = float(gradient @ (found.state.steps - steps))
        change, steps = change + moved, found.state.steps
        report(f"round {number}: {len(observations)} observations from {len(state.T_rig_odom)} keyframes, error "
               f"{found.sigma_px:.3f} px, lengths {100 * moved:+.3f} %")
        if number >= ROUNDS and abs(moved) < SETTLED:
            break
    sigma = float(np.sqrt(gradient @ found.covariance @ gradient))
    return DriveCalibration(start, found, first_sigma, change, sigma, len(state.T_rig_odom))


def distance_m(found: DriveCalibration) -> float:
    """Return the straight distance [m] between the first and the last keyframe."""
    ends = se3.inverse(found.adjustment.state.T_rig_odom[[0, -1]])[:, :3, 3]
    return float(np.linalg.norm(ends[1] - ends[0]))


def rescaled(rig: Rig, ratio: float) -> Rig:
    """Return the rig with a longer or shorter baseline: all lengths of its odometry change by that ratio."""
    viewpoint = rig.lower.viewpoint + ratio * (rig.upper.viewpoint - rig.lower.viewpoint)
    R_upper_rig = rig.upper.T_cam_rig[:3, :3]
    return replace(rig, upper=replace(rig.upper, T_cam_rig=se3.transform(R_upper_rig, -R_upper_rig @ viewpoint)))


def scale_gradient(found: DriveAdjustment) -> Array:
    """Return the relative change (P,) of lengths by each step of the rig, for the same pixels.

    Depth comes from the rays of both cameras to the same pixels; near landmarks count more, as in the odometry.
    """
    seen = found.observations
    key = seen.keyframe * (seen.landmark.max() + 1) + seen.landmark
    _, lower, upper = np.intersect1d(key[seen.camera == 0], key[seen.camera == 1], return_indices=True)
    pixels = seen.pixels[seen.camera == 0][lower], seen.pixels[seen.camera == 1][upper]
    ranges = _ranges(found.rig, pixels)
    weight = np.where(np.isfinite(ranges), ranges**-2, 0.0)
    gradient = np.zeros(len(found.prior))
    for k, step in enumerate(GRADIENT_STEP * np.eye(len(found.prior))):
        ahead, behind = (_ranges(found.parameters.at(found.state.steps + sign * step), pixels) for sign in (1, -1))
        change = np.nan_to_num(np.log(ahead / behind))
        gradient[k] = float(weight @ change / weight.sum()) / (2 * GRADIENT_STEP)
    return gradient


def _ranges(rig: Rig, pixels: tuple[Array, Array]) -> Array:
    """Return the distances (N,) from the lower viewpoint of points at pixels (N, 2) of both cameras."""
    rays = [m.camera.lift(p) @ m.T_cam_rig[:3, :3] for m, p in zip((rig.lower, rig.upper), pixels, strict=True)]
    points = common_perpendicular(rays[0], rays[1], rig.upper.viewpoint - rig.lower.viewpoint)
    return np.asarray(np.linalg.norm(points, axis=1))


def _with_masks(log: Path, rig: Rig, topics: Topics) -> Rig:
    reader = open_log(log, topics, rig)
    try:
        return with_rims(rig, reader.frames())
    finally:
        reader.close()


def _straightened(logs: Sequence[Path], rig: Rig, topics: Topics, config: Config, report: Callable[[str], None]) -> Rig:
    """Return the rig with its upper camera turned such that columns match, from where tracking works."""
    reader = open_log(logs[0], topics, rig)
    try:
        pairs = read_rig_pairs(reader, rig)
    finally:
        reader.close()
    for _ in range(DRIFT_ROUNDS):
        finding = check_rig(pairs, rig, config.panorama).finding
        if finding.drift is None:
            raise OmnidError(f"calibrate drive: {finding.summary}; are both cameras the ones of this rig, not "
                             "exchanged, and is there enough to see?")
        if finding.condition == "good":
            break
        report(finding.summary)
        rig = apply_drift(rig, finding.drift)
    return rig


def _collect(logs: Sequence[Path], rig: Rig, topics: Topics, config: Config
             ) -> tuple[DriveState, DriveObservations, list[int]]:
    """Return keyframes, landmarks and what was seen of them, and the first keyframe of each drive."""
    place = geometry(rig, config.panorama)
    states: list[DriveState] = []
    seen: list[DriveObservations] = []
    for log in logs:
        state, observations = _drive(log, place, topics, config, MAX_KEYFRAMES // len(logs))
        states.append(state)
        seen.append(observations)
    keyframes = np.cumsum([0, *(len(state.T_rig_odom) for state in states)])
    landmarks = np.cumsum([0, *(len(state.points) for state in states)])
    T_rig_odom = np.concatenate([state.T_rig_odom for state in states])
    _require_motion(T_rig_odom, len(logs))
    observations = DriveObservations(
        np.concatenate([part.keyframe + first for part, first in zip(seen, keyframes, strict=False)]),
        np.concatenate([part.landmark + first for part, first in zip(seen, landmarks, strict=False)]),
        np.concatenate([part.camera for part in seen]), np.concatenate([part.pixels for part in seen]))
    state = DriveState(T_rig_odom, np.concatenate([state.points for state in states]), np.zeros(0))
    return state, observations, keyframes[:-1].tolist()


def _drive(log: Path, place: Geometry, topics: Topics, config: Config, most: int
           ) -> tuple[DriveState, DriveObservations]:
    """Return at most so many keyframes of one drive, its landmarks, and their pixels in the images."""
    reader = open_log(log, topics, place.rig)
    try:
        updates = _updates(reader, place, config, log)
        landmarks = DriveLandmarks(place.model(NOISE_PX))
        T_rig_odom: list[Array] = []
        for update in _keyframes(updates, _spacing(reader, most)):
            seen = update.depth.panoramas
            T_odom_rect = update.T_odom_rig @ place.T_rig_rect
            landmarks.add(View(seen.lower, seen.upper, seen.visible, update.depth.disparity, T_odom_rect))
            T_rig_odom.append(se3.inverse(update.T_odom_rig))
    finally:
        reader.close()
    found = landmarks.observations()
    pixels = image_pixels(found, place.rig, place.cylinder)
    observations = DriveObservations(found.keyframe, found.landmark, found.camera, pixels)
    observations, used = observations.only(np.asarray(np.isfinite(pixels).all(axis=1)))
    return DriveState(np.array(T_rig_odom), found.points[used], np.zeros(0)), observations


def _spacing(reader: LogReader, most: int) -> int:
    """Return how many pairs at least lie between two keyframes, so that there are not too many."""
    pairs = reader.pair_estimate() or 0
    return max(1, -(-pairs // most))


def _keyframes(updates: Iterator[OdometryUpdate], apart: int) -> Iterator[OdometryUpdate]:
    """Yield the poses that lie apart far enough to tell something new."""
    last: Array | None = None
    since = 0
    for update in updates:
        since += 1
        if last is not None:
            moved = se3.log(se3.inverse(last) @ update.T_odom_rig)
            still = np.linalg.norm(moved[:3]) < KEYFRAME_M and np.linalg.norm(moved[3:]) < KEYFRAME_RAD
            if still or since < apart or update.state is TrackingState.LOST:
                continue
        last, since = update.T_odom_rig, 0
        yield update


def _updates(reader: LogReader, place: Geometry, config: Config, log: Path) -> Iterator[OdometryUpdate]:
    """Yield the poses of a log; OmnidError where the rig cannot be that of its cameras."""
    pairing, dewarp = Synchronise(place.rig, config.pair), Dewarp(place, config.panorama)
    gate = RigGate(place.cylinder, "warn")
    stereo, odometry = Stereo(place, config.stereo, gate), OdometryStage(place, config.odometry)
    states: Counter[TrackingState] = Counter()
    for pair in filter(None, map(pairing.process, reader.frames())):
        update = odometry.process(stereo.process(dewarp.process(pair)))
        states[update.state] += 1
        yield update
    if gate.exchanged:
        raise OmnidError(f"{log}: {gate.warning}")
    if not states or states[TrackingState.LOST] > MAX_LOST * states.total():
        raise OmnidError(f"{log}: the pose is lost in {states[TrackingState.LOST]} of {states.total()} pairs with this "
                         "rig; start from one that is nearer to the truth, or take a drive where there is more to see")


def _require_motion(T_rig_odom: Array, drives: int) -> None:
    """Raise OmnidError where the drives are too short or too straight to tell."""
    if len(T_rig_odom) < MIN_KEYFRAMES:
        raise OmnidError(f"calibrate drive: only {len(T_rig_odom)} views {KEYFRAME_M} m or "
                         f"{np.rad2deg(KEYFRAME_RAD):.0f} deg apart, {MIN_KEYFRAMES} are needed; take a longer drive")
    heading = se3.yaw(se3.inverse(T_rig_odom))
    change = (np.diff(heading) + np.pi) % (2 * np.pi) - np.pi
    if np.ptp(np.concatenate([[0.0], np.cumsum(change)])) < MIN_TURN_RAD:
        raise OmnidError(f"calibrate drive: {drives} drive(s) turn by less than {np.rad2deg(MIN_TURN_RAD):.0f} deg; on "
                         "a straight line some errors of the rig look like motion: take a drive with turns")


def _prior(parameters: RigParameters) -> Array:
    """Return the sigmas (P,) of the steps of a nominal rig; a step moves the image by about a pixel."""
    rows = zip(parameters.names, parameters.values, parameters.units, strict=True)
    return np.array([_prior_of(name.split()[-1], value, unit) for name, value, unit in rows])


def _prior_of(name: str, value: float, unit: float) -> float:
    """Return the sigma of a parameter in steps."""
    if name in ("r_x", "r_y", "r_z"):
        return float(TURN_SIGMA_RAD / unit)
    if name in ("e_x", "e_y"):
        return float(DIRECTION_SIGMA_RAD / unit)
    if name in ("pu", "pv", "center_row", "center_column"):
        return CENTRE_SIGMA_PX / unit
    if name == "xi":
        return XI_SIGMA / unit
    if name in ("k1", "k2", "p1", "p2", "c", "d"):
        return DISTORTION_SIGMA_PX
    return FOCAL_SIGMA * abs(value) / unit  # focal lengths and coefficients of a polynomial
