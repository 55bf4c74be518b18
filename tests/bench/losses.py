"""Recognition after a loss: `python -m tests.bench.losses FAMILY_sSEED ... [--size 384] [--count 40]`.

The odometry follows the first pairs of a rendered drive. Then it is dark, and the robot is found elsewhere: `ahead` on
its path, `turned` there to any heading, `covered`: the same while half of both panoramas shows nothing, in `another
world` of the same family, where no pose is right, or `back` where it had been, turned to any heading. Each view is
searched until it is recognised, in SEARCHES frames at most, with the support that the odometry asks for. Wrong is an
error of more than 5 cm or 1 degree.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from calib import se3
from omnid.core.odometry.estimates import OdometryLimits
from omnid.core.odometry.exposure_times import NO_VELOCITY, Exposure
from omnid.core.odometry.odometry import VisualOdometry
from omnid.core.odometry.stereo_frame import StereoFrame
from omnid.core.odometry.tracking import KltSettings
from omnid.core.places.recognition import Relocaliser
from omnid.core.stereo.matcher import Matcher, MatchingSettings
from omnid.core.types.panorama import PaddedPanorama
from tests.bench.results import Cell, ResultTable, columns, family_and_seed, run
from tests.omnid.core.scenery import PAD_PX, RenderedCameras, motion_errors
from tests.simulation.recipes import RECIPES, build

Array = NDArray[np.float64]

DRIVEN, AHEAD = 20, 12  # pairs that the odometry follows, and after them those among which the robot is found
ASIDE_M: Final = 0.15  # largest distance from the path, along each axis
STEP_M: Final = 0.1  # of the path between two pairs: slower drives leave some out
SEARCHES: Final = 8  # frames after which a view is given up
WRONG_M, WRONG_RAD = 0.05, math.radians(1)
OTHER: Final = 7000  # added to a seed for the other world
LOSSES: Final = ("ahead", "turned", "covered", "another world", "back")
COLUMNS: Final = columns(
    *("drive", "size|px", "loss", "views", "recognised|%|1", "wrong", "in the first frame|%|1"),
    *("error p50|mm|1", "error p95|mm|1", "heading p95|deg|2", "error over sigma, rms||2"),
    "longest search, processor time|ms|0",
)


class Found(NamedTuple):
    """Outcome of a view: searches until it was recognised (0: not), its errors, and the longest search."""

    searches: int
    error_m: float = math.nan
    error_rad: float = math.nan
    sigmas: float = math.nan
    work_s: float = 0.0

    @property
    def is_wrong(self) -> bool:
        """True if it was recognised elsewhere."""
        return self.searches > 0 and (self.error_m > WRONG_M or self.error_rad > WRONG_RAD)


@dataclass(frozen=True, slots=True)
class Drive:
    """A drive that ends in the dark: its cameras, those in another world, its poses, and what was kept of it."""

    cameras: RenderedCameras
    elsewhere: RenderedCameras
    poses: Array  # (N, 4, 4) T_world_rig
    odometry: VisualOdometry
    T_world_odom: Array  # of the rectified frames

    @staticmethod
    def of(family: str, seed: int, size: int) -> Drive:
        """Return the drive of a family that the odometry has followed."""
        run = build(family, seed, size)
        steps_m = np.linalg.norm(np.diff(run.poses[:, :3, 3], axis=0), axis=1)
        every = max(1, round(STEP_M / float(steps_m.mean())))
        poses = run.poses[:: min(every, len(run.poses) // (DRIVEN + AHEAD))]
        cameras = RenderedCameras.of(run.rig, run.scene)
        cameras = replace(cameras, matcher=Matcher(cameras.maps[0][0].shape, MatchingSettings()))
        elsewhere = replace(cameras, scene=build(family, seed + OTHER, size).scene)
        odometry = VisualOdometry(cameras.model, KltSettings(), OdometryLimits(), Relocaliser(cameras.model))
        for k in range(DRIVEN):
            estimate = odometry.process(cameras.frame(k, poses[k]), 0.2 * (k > 0))
        odometry.complete()
        T_world_rect = poses[DRIVEN - 1] @ se3.inverse(run.rig.T_rect_rig)
        return Drive(cameras, elsewhere, poses, odometry, T_world_rect @ se3.inverse(estimate.T_odom_rect))

    def found(self, loss: str, number: int, rng: np.random.Generator) -> Found:
        """Return what becomes of a view after a loss."""
        turn = rng.uniform(-0.3, 0.3) if loss == "ahead" else rng.uniform(-math.pi, math.pi)
        aside = rng.uniform(-ASIDE_M, ASIDE_M, 2)
        at = rng.integers(DRIVEN) if loss == "back" else DRIVEN + rng.integers(AHEAD)
        T_world_rig = self.poses[at] @ se3.exp([*aside, 0, 0, 0, turn])
        truth = se3.inverse(self.T_world_odom) @ T_world_rig @ se3.inverse(self.cameras.rig.T_rect_rig)
        cameras = self.elsewhere if loss == "another world" else self.cameras
        limits, longest_s = OdometryLimits(), 0.0
        for search in range(SEARCHES):
            frame = cameras.frame(10_000 + SEARCHES * number + search, T_world_rig)
            if loss == "covered":
                frame = half_covered(frame, int(rng.integers(frame.lower.width)))
            at_rest = Exposure(frame.times, NO_VELOCITY, cameras.model)
            started = time.process_time()
            pose = self.odometry.relocalise(frame, at_rest)
            longest_s = max(longest_s, time.process_time() - started)
            if pose is None or pose.inliers < limits.min_inliers or pose.inlier_ratio < limits.min_inlier_ratio:
                continue
            if loss == "another world":
                return Found(search + 1, math.inf, math.inf, math.inf, longest_s)
            error = se3.log(se3.inverse(pose.T_odom_rect) @ truth)
            sigmas = math.sqrt(float(error @ np.linalg.solve(pose.covariance, error)) / 6)
            return Found(search + 1, *motion_errors(pose.T_odom_rect, truth), sigmas, longest_s)
        return Found(0, work_s=longest_s)


def half_covered(frame: StereoFrame, first: int) -> StereoFrame:
    """Return the frame with half of the columns of both panoramas black, from one on, and not usable."""
    width = frame.lower.width
    hidden = (np.arange(width) - first) % width < width // 2
    disparity = np.array(frame.disparity)
    disparity[:, hidden] = np.nan
    padded = np.concatenate([hidden[-PAD_PX:], hidden, hidden[:PAD_PX]])
    panoramas = []
    for panorama in (frame.lower, frame.upper):
        image = panorama.image.copy()
        image[:, padded] = 0
        panoramas.append(PaddedPanorama(image, panorama.pad_px))
    return replace(
        frame, lower=panoramas[0], upper=panoramas[1], disparities=disparity, usable=frame.usable & ~hidden[None]
    )


def figures(found: Sequence[Found]) -> list[Cell]:
    """Return shares, errors and times of all views of a loss."""
    recognised = [each for each in found if each.searches]
    right = [each for each in recognised if not each.is_wrong]
    errors: list[Cell] = [None] * 4
    if right:
        errors = [
            1e3 * float(np.median([each.error_m for each in right])),
            1e3 * float(np.percentile([each.error_m for each in right], 95)),
            math.degrees(float(np.percentile([each.error_rad for each in right], 95))),
            float(np.sqrt(np.mean([each.sigmas**2 for each in right]))),
        ]
    return [
        100 * len(right) / len(found),
        len(recognised) - len(right),
        100 * sum(each.searches == 1 for each in right) / len(found),
        *errors,
        1e3 * max(each.work_s for each in found),
    ]


def losses(drives: Sequence[str], *, size: int = 384, count: int = 40) -> None:
    """Print a row for each loss of each drive FAMILY_sSEED, by so many views."""
    table = ResultTable("losses", "Recognition by the odometry after a loss", COLUMNS)
    for name in drives:
        named = family_and_seed(name)
        if named is None:
            raise SystemExit(f"{name}: expected FAMILY_sSEED, a family of {', '.join(RECIPES)}")
        drive = Drive.of(*named, size)
        for number, loss in enumerate(LOSSES):
            rng = np.random.default_rng([named[1], 51, number])
            found = [drive.found(loss, view, rng) for view in range(count)]
            table.add(name, size, loss, count, *figures(found), seed=named)


if __name__ == "__main__":
    run(losses)
