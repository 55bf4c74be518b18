"""Particle filter: it finds the pose from anywhere, tells an ambiguity, and resolves it once it can."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from calib import se3
from omnid.core.mapping.occupancy_grid import Grid
from omnid.core.mapping.scan_grid import scan_grid
from omnid.core.places.particle_filter import SCANS, ParticleEstimate, ParticleFilter, systematic_resample
from tests.omnid.core.mapping.rooms import OPEN, box, pose, scan_of

Array = NDArray[np.float64]

CORNERED = np.concatenate([box((-3, -2), (4, 2.5)), box((2.5, 1), (4, 2.5)), box((-3, -2), (-2, -0.5))])
SYMMETRIC = box((-3, -2), (3, 2))
# In the place of one of its short walls: a passage.
DOOR = np.array(
    [[[3, -2], [3, -0.6]], [[3, 0.6], [3, 2]], [[3, 0.6], [9, 0.6]], [[3, -0.6], [9, -0.6]], [[9, -0.6], [9, 0.6]]],
    float,
)
NOISE_M = 0.03


def grid_of(walls: Array, path: Array) -> Grid:
    """Return the map of a drive."""
    scans = [scan_of(walls, T, NOISE_M, 500 + n) for n, T in enumerate(path)]
    return scan_grid(scans, [OPEN] * len(path), path, 0.05).open_grid()


def drive(start: Array, steps: int, turn: float) -> Array:
    """Return poses (N, 4, 4) of a curve in steps of 0.2 m."""
    poses = [start]
    for _ in range(steps):
        poses.append(poses[-1] @ pose(0.2, 0, turn))
    return np.array(poses)


def run(filter: ParticleFilter, walls: Array, truth: Iterable[Array], seed: int = 0) -> list[ParticleEstimate]:
    """Drive through walls; odometry errs by 1 %."""
    rng, before, found = np.random.default_rng(seed), None, []
    for number, T in enumerate(truth):
        if before is not None:
            filter.move(se3.inverse(before) @ T @ pose(*(rng.normal(size=3) * [2e-3, 2e-3, 2e-3])))
        before = T
        found.append(filter.update(scan_of(walls, T, NOISE_M, 1000 * seed + number)))
    return found


def is_at(estimate: ParticleEstimate, T: Array) -> bool:
    """True if the estimate is within 15 cm and 5 degrees of a pose."""
    error = se3.log(se3.inverse(T) @ estimate.T_map_rect)
    return bool(np.linalg.norm(error[:3]) < 0.15 and abs(error[5]) < np.radians(5))


MAPPED = drive(pose(-1.5, 0.3, -0.1), 15, 0.02)


def test_the_pose_is_found_from_anywhere_at_any_heading() -> None:
    for seed in (1, 2, 3):
        truth = drive(pose(-1.0 + 0.4 * seed, 0.2, 2.0 * seed), 20, 0.3)
        found = run(ParticleFilter(grid_of(CORNERED, MAPPED), seed), CORNERED, truth, seed)
        assert not any(e.converged and not is_at(e, T) for e, T in zip(found, truth, strict=True))
        assert found[-1].converged and found[-1].fitting > 0.8 and found[-1].covariance[0, 0] < 0.15**2


def test_a_symmetric_room_is_ambiguous_as_long_as_one_drives_in_it() -> None:
    truth = drive(pose(-1.0, 0.2, 0.0), 40, 0.3)
    found = run(ParticleFilter(grid_of(SYMMETRIC, drive(pose(-1.5, 0.3, -0.1), 15, 0.02)), 1), SYMMETRIC, truth)
    assert not any(e.converged for e in found)
    assert any(e.ambiguous for e in found)


def test_leaving_the_symmetric_room_resolves_it() -> None:
    """The room has a door at one end only, and a passage behind it."""
    walls = np.concatenate([np.delete(SYMMETRIC, 1, axis=0), DOOR])
    path = drive(pose(-2.0, 0.0, 0.0), 45, 0.0)
    inside = drive(pose(-1.0, 0.4, 0.3), 10, 0.6)
    truth = np.concatenate([inside, drive(pose(-0.9, 0.0, 0.0), 30, 0.0)])
    found = run(ParticleFilter(grid_of(walls, path), 2), walls, truth)
    assert not any(e.converged and not is_at(e, T) for e, T in zip(found, truth, strict=True))
    assert found[-1].converged


def test_a_proposed_pose_is_taken_up() -> None:
    truth = drive(pose(-1.0, 0.2, 1.0), 2, 0.1)
    filter = ParticleFilter(grid_of(CORNERED, MAPPED), 4, particles=300)
    filter.start(scan_of(CORNERED, truth[0]), [truth[0] @ pose(0.1, -0.1, 0.05)])
    found = run(filter, CORNERED, truth)
    assert all(is_at(e, T) for e, T in zip(found, truth, strict=True))


def test_in_another_building_it_never_converges() -> None:
    elsewhere = np.concatenate([box((-5, -1), (1.2, 5)), box((-2, 2), (-1, 3))])
    found = run(ParticleFilter(grid_of(CORNERED, MAPPED), 5), elsewhere, drive(pose(-1.0, 0.2, 0.0), 25, 0.2))
    assert not any(e.converged for e in found)


def test_a_robot_that_was_carried_away_is_found_again() -> None:
    first, second = drive(pose(-1.0, 0.2, 0.0), 15, 0.3), drive(pose(2.0, -1.0, 2.0), 25, 0.25)
    filter = ParticleFilter(grid_of(CORNERED, MAPPED), 6)
    before, after = run(filter, CORNERED, first), run(filter, CORNERED, second, 1)
    assert before[-1].converged and after[-1].converged and is_at(after[-1], second[-1])
    assert not any(e.converged and not is_at(e, T) for e, T in zip(after[SCANS:], second[SCANS:], strict=True))


def test_without_ranges_or_without_a_map_there_is_no_pose() -> None:
    unknown = np.full(360, np.nan, np.float32)
    filter = ParticleFilter(grid_of(CORNERED, MAPPED), 7)
    assert not any(filter.update(unknown).converged for _ in range(2 * SCANS))
    assert not ParticleFilter(scan_grid([], [], np.zeros((0, 4, 4)), 0.05).open_grid()).update(unknown).converged


def test_resampling_takes_each_particle_about_as_often_as_its_weight_says() -> None:
    weight = np.array([0.1, 0.0, 0.5, 0.4])
    counts = np.zeros(4)
    for offset in (np.arange(100) + 0.5) / 100:
        chosen = np.bincount(systematic_resample(weight, offset), minlength=4)
        assert chosen.sum() == 4 and (np.abs(chosen - 4 * weight) < 1).all()
        counts += chosen
    np.testing.assert_allclose(counts / 400, weight, atol=0.01)
    assert systematic_resample(np.full(3, 0.3333), 0.9999).max() == 2  # weights whose sum is below 1 by rounding


def test_the_same_input_gives_the_same_result_and_numpys_generator_is_left_alone() -> None:
    grid, truth = grid_of(CORNERED, MAPPED), drive(pose(0.0, 0.2, 2.0), 6, 0.3)
    np.random.seed(5)
    expected = np.random.random()
    np.random.seed(5)
    first, second = (run(ParticleFilter(grid, 8), CORNERED, truth)[-1] for _ in range(2))
    assert np.random.random() == expected
    assert first.T_map_rect.tobytes() == second.T_map_rect.tobytes() and first.share == second.share
    assert first.covariance.tobytes() == second.covariance.tobytes()
