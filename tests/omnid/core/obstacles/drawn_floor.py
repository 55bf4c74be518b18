"""Floors, walls and poles, drawn into panoramas of two cameras above each other."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from calib.panorama import Cylinder
from omnid.core.types.panorama import PaddedPanorama

HEIGHT_M, BASELINE_M = 0.9, 0.2
CYLINDER = Cylinder(872, 253, 86.0)
PAD_PX = 24
T_RECT_BASE = np.eye(4)
T_RECT_BASE[2, 3] = -HEIGHT_M
Pattern = Callable[[np.ndarray, np.ndarray], np.ndarray]


def plain(x_m: np.ndarray, y_m: np.ndarray) -> np.ndarray:
    """Return one grey level."""
    return np.full(np.shape(x_m), 120.0)


def worn(x_m: np.ndarray, y_m: np.ndarray) -> np.ndarray:
    """Return grey levels of a floor whose stains are little stronger than noise."""
    return np.asarray(
        120.0
        + 3.0 * (np.sin(31 * x_m + 3) * np.sin(23 * y_m) + np.sin(17 * x_m - 29 * y_m) + np.sin(13 * x_m + 37 * y_m))
    )


def worn_with_line(x_m: np.ndarray, y_m: np.ndarray) -> np.ndarray:
    """Return grey levels of such a floor with a white line of 10 cm around the robot, 1.5 m away."""
    return np.where(np.abs(np.hypot(x_m, y_m) - 1.55) < 0.05, 230.0, worn(x_m, y_m))


def ribbed(x_m: np.ndarray, y_m: np.ndarray) -> np.ndarray:
    """Return grey levels of identical ribs of 11 cm across each direction."""
    return np.asarray(120.0 + 50.0 * np.sign(np.sin(math.tau * np.hypot(x_m, y_m) / 0.11)))


def stains(x_m: np.ndarray, y_m: np.ndarray) -> np.ndarray:
    """Return grey levels of a floor with strong stains of all directions."""
    waves = ((31, 5), (-17, 29), (43, -37), (11, 53), (59, 23))
    total = sum(np.sin(a * x_m + b * y_m + a) for a, b in waves)
    return np.asarray(120.0 + 12.0 * total)


def striped(azimuth: np.ndarray, height_m: np.ndarray) -> np.ndarray:
    """Return grey levels of a wall, by azimuth and height over the floor."""
    return np.asarray(120.0 + 30.0 * np.sin(25 * height_m + np.sin(9 * azimuth)) + 20.0 * np.sin(61 * height_m + 2))


def courses(azimuth: np.ndarray, height_m: np.ndarray) -> np.ndarray:
    """Return grey levels of a wall of bricks: identical pairs of courses of 9 cm, with joints of 1 cm."""
    face = np.where(height_m % 0.18 < 0.09, 85.0, 95.0) + 0.0 * azimuth
    return np.where(height_m % 0.09 < 0.01, 170.0, face)


@dataclass(frozen=True)
class Pole:
    """A pole higher than the cameras, of one grey level, straight ahead."""

    range_m: float
    width_m: float
    grey: float = 190.0


@dataclass(frozen=True)
class Bar:
    """A bar around the robot, of one grey level, over floor that is seen below and beyond it."""

    range_m: float
    heights_m: tuple[float, float]
    grey: float = 190.0


@dataclass(frozen=True)
class Block:
    """A low object around the robot, of one grey level or with a pattern all over, with floor behind it."""

    range_m: float
    depth_m: float
    height_m: float
    grey: float = 75.0
    pattern: Pattern | None = None


@dataclass(frozen=True)
class Slope:
    """The floor beyond a line across the way rises."""

    start_m: float
    degrees: float


@dataclass(frozen=True)
class Walls:
    """Two plain walls along the way, on both sides of the robot, with skirting boards."""

    lateral_m: float
    grey: float = 190.0
    board_grey: float = 60.0


Obstacle = Pole | Bar | Block | Slope | Walls


def panoramas(
    floor: Pattern, wall_m: float, wall: Pattern, drop_m: float = 0.0, obstacle: Obstacle | None = None, seed: int = 4
) -> tuple[PaddedPanorama, PaddedPanorama]:
    """Return the lower and the upper panorama of a floor with a round wall; wall: grey of azimuth and height.

    drop_m: how far the floor lies below its height by the rig. seed: of the noise.
    """
    rng = np.random.default_rng(seed)
    lower, upper = (
        _exposed(_drawn(height + drop_m, floor, wall_m, wall, obstacle), rng)
        for height in (HEIGHT_M, HEIGHT_M + BASELINE_M)
    )
    return lower, upper


def _exposed(grey: np.ndarray, rng: np.random.Generator) -> PaddedPanorama:
    """Return grey levels with noise."""
    image = grey + rng.normal(0.0, 1.0, grey.shape)
    padded = np.pad(np.clip(np.rint(image), 0, 255).astype(np.uint8), ((0, 0), (PAD_PX, PAD_PX)), mode="wrap")
    return PaddedPanorama(padded, PAD_PX, noise_grey=1.0)


@lru_cache(maxsize=16)  # most pairs differ in their noise only
def _drawn(height_m: float, floor: Pattern, wall_m: float, wall: Pattern, obstacle: Obstacle | None) -> np.ndarray:
    """Return the grey levels of a panorama without noise."""
    columns, rows = np.meshgrid(np.arange(CYLINDER.width), np.arange(CYLINDER.height))
    rays = CYLINDER.rays(np.column_stack([columns.ravel(), rows.ravel()]).astype(float))
    with np.errstate(divide="ignore"):
        r = np.where(rays[:, 2] < 0, -height_m / rays[:, 2], np.inf)
        if isinstance(obstacle, Slope):
            slope = math.tan(math.radians(obstacle.degrees))
            steeper = slope * rays[:, 0] - rays[:, 2]
            on_slope = np.where(steeper > 0, (height_m + slope * obstacle.start_m) / steeper, np.inf)
            r = np.where(r * rays[:, 0] > obstacle.start_m, on_slope, r)
    near = np.minimum(r, wall_m)
    x, y, z = (near * rays.T[i] for i in range(3))
    azimuth = np.arctan2(y, x)
    grey = np.where(r < wall_m, floor(x, y), wall(azimuth, height_m + z))
    if isinstance(obstacle, Pole):
        hidden = (np.abs(azimuth) < obstacle.width_m / obstacle.range_m / 2) & (r > obstacle.range_m)
        grey = np.where(hidden, obstacle.grey, grey)
    elif isinstance(obstacle, Walls):
        to_wall_m = obstacle.lateral_m / np.abs(rays[:, 1])
        of_wall = np.where(height_m + to_wall_m * rays[:, 2] < 0.08, obstacle.board_grey, obstacle.grey)
        grey = np.where(to_wall_m < near, of_wall, grey)
    elif isinstance(obstacle, Bar):
        height = height_m + obstacle.range_m * rays[:, 2]
        grey = np.where((height > obstacle.heights_m[0]) & (height < obstacle.heights_m[1]), obstacle.grey, grey)
    elif isinstance(obstacle, Block):
        at_front_m = height_m + obstacle.range_m * rays[:, 2]
        on_top_m = r * (1 - obstacle.height_m / height_m)
        is_top = (on_top_m > obstacle.range_m) & (on_top_m < obstacle.range_m + obstacle.depth_m)
        is_front = (at_front_m > 0) & (at_front_m < obstacle.height_m)
        shown: float | np.ndarray = obstacle.grey
        if obstacle.pattern is not None:
            along_m = np.where(is_front, obstacle.range_m - at_front_m, np.minimum(on_top_m, wall_m))  # over its edge
            shown = obstacle.pattern(along_m * np.cos(azimuth), along_m * np.sin(azimuth))
        grey = np.where(is_top | is_front, shown, grey)
    return np.asarray(grey.reshape(columns.shape))
