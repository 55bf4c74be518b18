"""Particle filter on a map (Monte Carlo localisation): for places that the panorama cannot tell, or no longer knows.

Thrun, Burgard, Fox 2005, "Probabilistic Robotics", chapter 8. Particles move by odometry and are weighted by the range
scan. Particles alone do not show an ambiguity, because one of two equal groups dies out by chance: so a pose counts
only if a search of the whole map finds no other one that explains the last scans as well.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from calib.se2_arrays import composed, planar, relative, transform, wrapped
from omnid.core.mapping.occupancy_grid import Grid
from omnid.core.mapping.range_scan import RangeScan
from omnid.core.places.beam_model import BeamModel

Array = NDArray[np.float64]

# Set by trial on development seeds, where a line gives no other reason.
PARTICLES: Final = 1000
DRAWN_PER_M2: Final = 400  # poses that a search of the whole map draws
MAX_DRAWN: Final = 100_000
BEST_DRAWN: Final = 200  # The best of them, which are improved.
ROUNDS: Final = 6  # Rounds of improvement: random changes, smaller each time.
CHANGE: Final = np.array([0.15, 0.15, 0.15])  # m, rad: standard deviation of the changes of the first round
SEED_SIGMA: Final = np.array([0.2, 0.2, 0.1])  # m, rad: standard deviation of the poses that signatures propose.
SEEDED: Final = 0.7  # share of the particles at the start that are at such poses
MOTION_SIGMA: Final = np.array([0.02, 0.02, 0.01])  # m, rad: added with each motion, so that particles differ
MOTION_RATIO: Final = 0.05  # The same by the length of the motion.
SCANS: Final = 8  # last scans that decide whether there is another pose
GROUP_M, GROUP_RAD = 0.8, math.radians(25)  # distance up to which poses are one group
SHARE: Final = 0.9  # Share of the weight in one group from which it may be the pose.
SIGMA_XY_M, SIGMA_YAW_RAD = 0.2, math.radians(5)  # Largest standard deviations of a group that is the pose.
FITTING: Final = 0.75  # share of the beams that must end at obstacles of the map, in the mean of the last scans
MARGIN: Final = 10.0  # Log likelihood by which the pose must be better than any other.
# With less fitting beams, after which the whole map is searched again; 1 m of motion; by trial on development seeds.
LOST_UPDATES: Final = 5


@dataclass(frozen=True, slots=True)
class ParticleEstimate:
    """Pose of the heaviest group of particles; it is the pose of the robot only if `converged`."""

    T_map_rect: Array  # (4, 4) on the floor
    covariance: Array  # (3, 3) of x, y, yaw in the map, m^2 and rad^2
    share: float  # share of the weight in the group
    fitting: float  # share of the beams that end at obstacles of the map, in the mean of the last scans
    ambiguous: bool  # another pose explains the last scans as well, or several groups are left that do
    converged: bool


class ParticleFilter:
    """Particles (x, y, yaw) of the scan's frame in the map; the same input gives the same result."""

    def __init__(self, grid: Grid, seed: int = 0, particles: int = PARTICLES) -> None:
        self._model, self._rng, self._count = BeamModel(grid), np.random.default_rng(seed), particles
        self._poses, self._log_weight = np.zeros((0, 3)), np.zeros(0)
        # last scans, with the pose (3,) of odometry at each
        self._scans: deque[tuple[RangeScan, Array]] = deque(maxlen=SCANS)
        self._fitting: deque[float] = deque(maxlen=SCANS)
        self._T_odom_rect = np.eye(4)
        self._poor_updates = 0  # one after the other
        self._is_only = False  # a search of the map has found no other pose

    def start(self, scan: RangeScan, proposed: Sequence[Array] = ()) -> None:
        """Place the particles where a scan fits the map, most of them at proposed poses T_map_rect (4, 4)."""
        seeded = round(SEEDED * self._count) if len(proposed) else 0
        drawn = self._model.drawn(self._search_size(), self._rng)
        weight = _normalised(self._model.log_likelihood(drawn, scan, coarse=True))
        found = drawn[self._rng.choice(len(drawn), self._count - seeded, p=weight)] if len(drawn) else drawn
        if seeded:
            at = np.array([planar(T) for T in proposed])[self._rng.integers(0, len(proposed), seeded)]
            found = np.concatenate([at + SEED_SIGMA * self._rng.normal(size=(seeded, 3)), found])
        self._poses, self._log_weight = found, np.zeros(len(found))
        self._poor_updates, self._is_only = 0, False
        self._scans.clear()
        self._fitting.clear()

    def move(self, T_before_now: Array) -> None:
        """Move all particles by a motion of the scan's frame, as odometry measured it."""
        self._T_odom_rect = self._T_odom_rect @ T_before_now
        step = planar(T_before_now)
        sigma = MOTION_SIGMA + MOTION_RATIO * np.array([np.hypot(step[0], step[1])] * 2 + [abs(step[2])])
        self._poses = composed(self._poses, step + sigma * self._rng.normal(size=self._poses.shape))

    def update(self, scan: RangeScan, proposed: Sequence[Array] = ()) -> ParticleEstimate:
        """Weight the particles by a scan and return the estimate; to be called when the robot has moved.

        proposed: poses T_map_rect (4, 4) at which most of the particles are placed where the filter begins.
        """
        # 1. Begin, or begin again where the map has long not fitted.
        if not len(self._poses) or self._poor_updates >= LOST_UPDATES:
            self.start(scan, proposed)
        self._scans.append((scan, planar(self._T_odom_rect)))
        if not len(self._poses):
            return ParticleEstimate(np.eye(4), np.full((3, 3), np.inf), 0.0, 0.0, True, False)
        # 2. Weight by the likelihood of the scan.
        self._log_weight += self._model.log_likelihood(self._poses, scan)
        weight = _normalised(self._log_weight)
        # 3. The heaviest group; if it alone is left, search the map for another pose.
        estimate = self._estimate(weight, scan)
        self._poor_updates = self._poor_updates + 1 if self._fitting[-1] < FITTING else 0
        # 4. Resample where few particles carry the weight.
        weight = _normalised(self._log_weight)  # even where the particles have been placed at two poses
        if 1 / (weight**2).sum() < len(weight) / 2:
            self._poses = self._poses[systematic_resample(weight, self._rng.random())]
            self._log_weight = np.zeros(len(self._poses))
        return estimate

    def _estimate(self, weight: Array, scan: RangeScan) -> ParticleEstimate:
        """Return the estimate; place the particles at both poses where there is another one as good."""
        pose, covariance, share = _heaviest_group(self._poses, weight)
        self._fitting.append(self._model.fitting(pose, scan))
        fitting = sum(self._fitting) / len(self._fitting)
        sigma = np.sqrt(np.diag(covariance))
        is_one = share >= SHARE and sigma[:2].max() < SIGMA_XY_M and sigma[2] < SIGMA_YAW_RAD and fitting >= FITTING
        ambiguous = share < SHARE and fitting >= FITTING and len(self._scans) == SCANS
        if is_one and not self._is_only and len(self._scans) == SCANS:
            other = self._other_pose(pose)
            ambiguous, self._is_only = other is not None, other is None
            if other is not None:
                self._split(pose, other)
        return ParticleEstimate(transform(pose), covariance, share, fitting, ambiguous, is_one and self._is_only)

    def _other_pose(self, pose: Array) -> Array | None:
        """Return a pose elsewhere that explains the last scans as well as `pose`; None where there is none."""
        drawn = self._model.drawn(self._search_size(), self._rng)
        drawn = drawn[~_is_near(drawn, pose)]
        if not len(drawn):
            return None
        # The newest and the oldest scan together, because many places resemble each other from one pose only.
        fit = sum(
            self._model.log_likelihood(self._at(drawn, odometry), scan, coarse=True)
            for scan, odometry in (self._scans[0], self._scans[-1])
        )
        other, score = self._improved(drawn[np.argsort(-fit, kind="stable")[:BEST_DRAWN]], pose)
        _, best = self._improved(pose[None], None)
        return other if score > best - MARGIN else None

    def _improved(self, poses: Array, away_from: Array | None) -> tuple[Array, float]:
        """Return a pose (3,) near some of the poses (K, 3) that explains the last scans best, and its log likelihood.

        Random changes, smaller in each round; the better half of the poses is continued twice.
        """
        poses = np.resize(poses, (BEST_DRAWN, 3))
        score = self._joint(poses)
        for number in range(ROUNDS):
            best = np.argsort(-score, kind="stable")[: BEST_DRAWN // 2]
            poses, score = np.tile(poses[best], (2, 1)), np.tile(score[best], 2)
            tried = poses + CHANGE / 1.5**number * self._rng.normal(size=poses.shape)
            found = self._joint(tried)
            if away_from is not None:
                found = np.where(_is_near(tried, away_from), -np.inf, found)
            poses, score = np.where((found > score)[:, None], tried, poses), np.maximum(found, score)
        return poses[score.argmax()], float(score.max())

    def _joint(self, poses: Array) -> Array:
        """Return the log likelihoods (K,) of the last scans, if the robot is at poses (K, 3) now."""
        return np.asarray(
            sum(self._model.log_likelihood(self._at(poses, odometry), scan) for scan, odometry in self._scans)
        )

    def _at(self, poses: Array, odometry: Array) -> Array:
        """Return the poses (K, 3) at the time of an earlier scan of robots that are now at poses (K, 3)."""
        return composed(poses, relative(self._scans[-1][1], odometry))

    def _split(self, pose: Array, other: Array) -> None:
        """Place one half of the particles at each pose."""
        half = len(self._poses) // 2
        centres = np.where(np.arange(len(self._poses))[:, None] < half, pose, other)
        self._poses = centres + MOTION_SIGMA * self._rng.normal(size=centres.shape)
        self._log_weight = np.zeros(len(self._poses))

    def _search_size(self) -> int:
        return int(np.clip(DRAWN_PER_M2 * self._model.free_m2, self._count, MAX_DRAWN))


def systematic_resample(weight: Array, offset: float) -> NDArray[np.intp]:
    """Return N indices into weights (N,) of sum 1, each index about N times its weight (systematic resampling).

    One offset in [0, 1) shifts N equally spaced positions on the cumulative weights (Thrun et al. 2005, table 4.4).
    filterpy's function is not used: it draws from numpy's global generator, which other threads share.
    """
    positions = (np.arange(len(weight)) + offset) / len(weight)
    # Rounding may leave the last sum just below 1; no position lies beyond the last particle.
    return np.minimum(np.searchsorted(np.cumsum(weight), positions, side="right"), len(weight) - 1)


def _heaviest_group(poses: Array, weight: Array) -> tuple[Array, Array, float]:
    """Return mean (3,), covariance (3, 3) and weight of the group of poses (N, 3) that weighs most."""
    cells = np.floor(poses / [GROUP_M, GROUP_M, GROUP_RAD]).astype(np.int64)
    _, cell = np.unique(cells, axis=0, return_inverse=True)
    centre = poses[cell == np.bincount(cell, weight).argmax()][0]
    for _ in range(2):
        member = weight * _is_near(poses, centre)
        share = float(member.sum())
        apart = poses - centre
        apart[:, 2] = wrapped(apart[:, 2])
        # Sums over particles in their order: those of BLAS depend on its threads, and the result would differ by a bit.
        centre = centre + (member[:, None] * apart).sum(axis=0) / share
    apart = poses - centre
    apart[:, 2] = wrapped(apart[:, 2])
    outer = member[:, None, None] * apart[:, :, None] * apart[:, None, :]
    return centre, np.asarray(outer.sum(axis=0) / share), share


def _is_near(poses: Array, centre: Array) -> NDArray[np.bool_]:
    """Return flags (N,) of the poses (N, 3) that belong to one group with a pose (3,)."""
    apart = poses - centre
    return np.asarray((np.hypot(apart[:, 0], apart[:, 1]) < GROUP_M) & (np.abs(wrapped(apart[:, 2])) < GROUP_RAD))


def _normalised(log_weight: Array) -> Array:
    """Return weights (N,) of sum 1."""
    weight = np.exp(log_weight - log_weight.max(initial=-np.inf))
    return np.asarray(weight / weight.sum())
