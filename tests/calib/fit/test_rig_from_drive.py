"""Bundle adjustment of a rig from a drive: exact observations give the exact rig, noisy ones an honest sigma."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calib import se3
from calib.fit.parameters import LINE_TIME, UPPER_DELAY, RigParameters
from calib.fit.rig_from_drive import (
    DriveObservations,
    DriveProblem,
    DriveState,
    adjust_drive,
    observation_sigma,
    project,
)
from calib.models.camera import Array
from calib.rig import Rig
from tests.simulation.paths import loop, vibrate
from tests.simulation.rigs import make_rig

KEYFRAMES, LANDMARKS = 14, 150
NOISE_PX = 0.03


@pytest.fixture(scope="module")
def truth() -> Rig:
    return make_rig(size=512, baseline_m=0.22, misaligned_deg=(0.6, -0.4, 0.5), lower_misaligned_deg=(0.3, 0.2, 0.0))


def drive(truth: Rig, seed: int, noise_px: float = NOISE_PX) -> tuple[DriveState, DriveObservations]:
    """Return keyframes of a round through a room, landmarks on its walls, and where both cameras see them."""
    rng = np.random.default_rng(seed)
    poses = vibrate(loop(seed, KEYFRAMES), seed)
    T_rig_odom = se3.inverse(se3.inverse(poses[0]) @ poses)
    azimuth, range_m = rng.uniform(-np.pi, np.pi, LANDMARKS), rng.uniform(1.6, 4.0, LANDMARKS)
    points = np.column_stack([range_m * np.cos(azimuth), range_m * np.sin(azimuth), rng.uniform(-1.0, 1.2, LANDMARKS)])
    points -= [*poses[0][:2, 3].tolist(), 0.0]
    keyframe, landmark, camera = (part.ravel() for part in np.mgrid[:KEYFRAMES, :LANDMARKS, :2])
    in_rig = se3.apply(T_rig_odom, points)[keyframe, landmark]
    pixels = project(truth, camera, in_rig) + noise_px * rng.standard_normal((len(keyframe), 2))
    seen = np.isfinite(pixels).all(axis=1) & (np.linalg.norm(in_rig, axis=1) > 0.7)
    state = DriveState(T_rig_odom, points, np.zeros((KEYFRAMES, 6)), np.zeros(KEYFRAMES), np.zeros(0))
    return state, DriveObservations(keyframe[seen], landmark[seen], camera[seen], pixels[seen])


def disturbed(rig: Rig, rng: np.random.Generator) -> Rig:
    """Return a rig whose parameters are off by about a pixel each."""
    parameters = RigParameters.about(rig)
    return parameters.at(rng.uniform(-1, 1, len(parameters.names)))


def start(state: DriveState, parameters: RigParameters, rng: np.random.Generator) -> DriveState:
    """Return a state whose poses and landmarks are off by centimetres, as odometry with a wrong rig gives them."""
    turned = se3.exp(0.01 * rng.standard_normal((KEYFRAMES, 6))) @ state.T_rig_odom
    turned[0] = state.T_rig_odom[0]
    points = state.points * (1 + 0.02 * rng.standard_normal((LANDMARKS, 1)))
    return replace(state, T_rig_odom=turned, points=points, steps=np.zeros(len(parameters.names)))


def rays_apart_deg(a: Rig, b: Rig) -> Array:
    """Return the angles between the rays of both rigs' lower and upper cameras, in the rig frame."""
    angles = np.linspace(-np.pi, np.pi, 60)
    radii = np.array([60.0, 120.0, 180.0])
    grid = (radii[:, None, None] * np.stack([np.cos(angles), np.sin(angles)], axis=-1)).reshape(-1, 2) + 255.5
    apart = []
    for side in ("lower", "upper"):
        one, other = (getattr(rig, side).camera.lift(grid) @ getattr(rig, side).T_cam_rig[:3, :3] for rig in (a, b))
        apart.append(np.arccos(np.clip((one * other).sum(axis=1), -1, 1)))
    return np.rad2deg(np.concatenate(apart))


def test_a_disturbed_rig_becomes_the_true_one(truth: Rig) -> None:
    rng = np.random.default_rng(1)
    state, observations = drive(truth, 1)
    rig = disturbed(truth, rng)
    parameters = RigParameters.about(rig)
    found = adjust_drive(parameters, start(state, parameters, rng), observations)
    assert np.median(rays_apart_deg(rig, truth)) > 0.1
    assert np.median(rays_apart_deg(found.rig, truth)) < 0.01
    assert found.rig.baseline_m == pytest.approx(truth.baseline_m, rel=1e-9)
    assert found.sigma_px == pytest.approx(NOISE_PX, rel=0.15)
    assert observation_sigma(rig, found) > 3 * found.sigma_px


def test_sigmas_are_those_of_the_errors(truth: Rig) -> None:
    """Errors divided by their sigmas are of order one, over all parameters of some drives."""
    parameters = RigParameters.about(truth)
    ratios = []
    for seed in range(2):
        state, observations = drive(truth, seed)
        begin = replace(state, steps=np.zeros(len(parameters.names)))
        found = adjust_drive(parameters, begin, observations)
        ratios.append(found.state.steps / np.sqrt(np.diag(found.covariance)))
    assert 0.5 < np.sqrt(np.mean(np.square(ratios))) < 1.8


def test_landmarks_that_move_are_left_out(truth: Rig) -> None:
    rng = np.random.default_rng(3)
    state, observations = drive(truth, 3)
    wandering = observations.landmark < 30
    pixels = observations.pixels + np.where(wandering[:, None], rng.uniform(-4, 4, observations.pixels.shape), 0.0)
    parameters = RigParameters.about(truth)
    begin = replace(state, steps=np.zeros(len(parameters.names)))
    found = adjust_drive(parameters, begin, replace(observations, pixels=pixels))
    assert len(found.state.points) <= LANDMARKS - 30
    assert np.median(rays_apart_deg(found.rig, truth)) < 0.01


def test_a_keyframe_of_which_no_landmark_is_left_stays(truth: Rig) -> None:
    """Its pose is an unknown that no observation shows."""
    state, observations = drive(truth, 4)
    kept, used = observations.only(observations.keyframe != 5)
    parameters = RigParameters.about(truth)
    begin = replace(state, points=state.points[used], steps=np.zeros(len(parameters.names)))
    found = adjust_drive(parameters, begin, kept)
    assert np.isfinite(found.covariance).all() and np.median(rays_apart_deg(found.rig, truth)) < 0.01
    np.testing.assert_array_equal(found.state.T_rig_odom[5], state.T_rig_odom[5])


def problem_points(truth: Rig, state: DriveState, observations: DriveObservations) -> Array:
    """Return the landmark of each observation in the rig frame."""
    parameters = RigParameters.about(truth)
    problem = DriveProblem(parameters, observations, parameters.prior())
    return problem.in_rig(replace(state, steps=np.zeros(15)), np.zeros(15))


def test_delay_of_the_upper_camera_and_line_time_are_found(truth: Rig) -> None:
    """The upper camera is exposed 12 ms late, rows follow by 30 us; the rig turns and drives at changing speed."""
    rng = np.random.default_rng(6)
    state, observations = drive(truth, 6)
    twist = np.column_stack(
        [rng.uniform(-0.7, 0.7, (KEYFRAMES, 2)), np.zeros((KEYFRAMES, 3)), rng.uniform(-0.8, 0.8, KEYFRAMES)]
    )
    delay_s = np.where(observations.camera == 1, 12e-3, 0.0) + 30e-6 * observations.pixels[:, 1]
    points = problem_points(truth, state, observations)
    moving = np.array(
        [
            se3.apply(se3.exp(-t * v), p[None])[0]
            for t, v, p in zip(delay_s, twist[observations.keyframe], points, strict=True)
        ]
    )
    pixels = project(truth, observations.camera, moving) + NOISE_PX * rng.standard_normal((len(points), 2))
    seen = np.isfinite(pixels).all(axis=1)
    kept, used = replace(observations, pixels=pixels).only(seen)
    parameters = RigParameters.about(truth, times=(UPPER_DELAY, LINE_TIME))
    begin = replace(state, points=state.points[used], steps=np.zeros(17), twist=twist)
    begin = replace(begin, upper_delay_s=np.full(KEYFRAMES, 5e-3))
    found = adjust_drive(parameters, begin, kept)
    times = parameters.times_at(found.state.steps)
    assert times.upper_delay_s == pytest.approx(7e-3, abs=3e-4)
    assert times.line_time_s == pytest.approx(30e-6, abs=1e-6)
    assert np.median(rays_apart_deg(found.rig, truth)) < 0.01
