"""Bundle adjustment of a rig from a drive: exact observations give the exact rig, noisy ones an honest sigma."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from calib import se3
from calib.errors import CalibError
from calib.fit.drive_bundle import (
    DriveObservations,
    DriveState,
    RigParameters,
    adjust_drive,
    observation_sigma,
    project,
)
from calib.models.camera import Array
from calib.rig import Rig
from tests.simulation.paths import loop, vibrate
from tests.simulation.rigs import make_rig

KEYFRAMES, LANDMARKS = 24, 240
NOISE_PX = 0.03
PRIOR_STEPS = 3.0  # pixels, or what moves the image by about so many


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
    return DriveState(T_rig_odom, points, np.zeros(0)), DriveObservations(
        keyframe[seen], landmark[seen], camera[seen], pixels[seen])


def disturbed(rig: Rig, rng: np.random.Generator) -> Rig:
    """Return a rig whose parameters are off by about a pixel each."""
    parameters = RigParameters.about(rig)
    return parameters.at(rng.uniform(-1, 1, len(parameters.names)))


def start(state: DriveState, parameters: RigParameters, rng: np.random.Generator) -> DriveState:
    """Return a state whose poses and landmarks are off by centimetres, as odometry with a wrong rig gives them."""
    turned = se3.exp(0.01 * rng.standard_normal((KEYFRAMES, 6))) @ state.T_rig_odom
    turned[0] = state.T_rig_odom[0]
    points = state.points * (1 + 0.02 * rng.standard_normal((LANDMARKS, 1)))
    return DriveState(turned, points, np.zeros(len(parameters.names)))


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
    found = adjust_drive(parameters, start(state, parameters, rng), observations, np.full(15, PRIOR_STEPS))
    assert np.median(rays_apart_deg(rig, truth)) > 0.1
    assert np.median(rays_apart_deg(found.rig, truth)) < 0.01
    assert found.rig.baseline_m == pytest.approx(truth.baseline_m, rel=1e-9)
    assert found.sigma_px == pytest.approx(NOISE_PX, rel=0.15)
    assert found.seen.all()
    assert observation_sigma(rig, found) > 3 * found.sigma_px


def test_sigmas_are_those_of_the_errors(truth: Rig) -> None:
    """Errors over said sigmas are of order one, over all parameters of some drives."""
    parameters = RigParameters.about(truth)
    ratios = []
    for seed in range(3):
        state, observations = drive(truth, seed)
        begin = replace(state, steps=np.zeros(len(parameters.names)))
        found = adjust_drive(parameters, begin, observations, np.full(15, PRIOR_STEPS))
        ratios.append(found.state.steps / found.sigmas)
    assert 0.5 < np.sqrt(np.mean(np.square(ratios))) < 1.8


def test_landmarks_that_move_are_left_out(truth: Rig) -> None:
    rng = np.random.default_rng(3)
    state, observations = drive(truth, 3)
    wandering = observations.landmark < 40
    pixels = observations.pixels + np.where(wandering[:, None], rng.uniform(-4, 4, observations.pixels.shape), 0.0)
    parameters = RigParameters.about(truth)
    begin = replace(state, steps=np.zeros(len(parameters.names)))
    found = adjust_drive(parameters, begin, replace(observations, pixels=pixels), np.full(15, PRIOR_STEPS))
    assert len(found.state.points) <= LANDMARKS - 40
    assert np.median(rays_apart_deg(found.rig, truth)) < 0.01


def test_pixels_at_random_are_refused(truth: Rig) -> None:
    state, observations = drive(truth, 4)
    pixels = np.random.default_rng(4).uniform(0, 511, observations.pixels.shape)
    parameters = RigParameters.about(truth)
    begin = replace(state, steps=np.zeros(len(parameters.names)))
    with pytest.raises(CalibError, match="px off any rig and path"):
        adjust_drive(parameters, begin, replace(observations, pixels=pixels), np.full(15, PRIOR_STEPS))
