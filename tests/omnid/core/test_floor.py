"""The plane of the floor among points of rooms that are known."""

from __future__ import annotations

import numpy as np
import pytest

from calib import se3
from omnid.core.floor import Floor, common_floor, fit_floor

HEIGHT_M, PAIRS = 1.2, 12
Points = tuple[np.ndarray, np.ndarray]


def noisy(points: np.ndarray, rng: np.random.Generator) -> Points:
    """Return points about the viewpoint with the noise of stereo along their rays, and its variance, stated doubly."""
    distance = np.linalg.norm(points, axis=1)
    sigma = 0.01 * distance**2
    along = points * (1 + rng.normal(0, 0.5, len(points)) * sigma / distance)[:, None]
    return along, sigma**2


def plane(
    count: int,
    rng: np.random.Generator,
    height_m: float = HEIGHT_M,
    slope: tuple[float, float] = (0.0, 0.0),
    azimuths: tuple[float, float] = (-np.pi, np.pi),
) -> np.ndarray:
    """Return points of a plane below the cameras."""
    angle, r = rng.uniform(*azimuths, count), rng.uniform(0.8, 3.5, count)
    x, y = r * np.cos(angle), r * np.sin(angle)
    return np.column_stack([x, y, -height_m + slope[0] * x + slope[1] * y])


def walls(count: int, rng: np.random.Generator, range_m: float = 2.0, low_m: float = -HEIGHT_M) -> np.ndarray:
    """Return points of a round wall that stands on the floor."""
    angle = rng.uniform(-np.pi, np.pi, count)
    return np.column_stack([range_m * np.cos(angle), range_m * np.sin(angle), rng.uniform(low_m, 1.0, count)])


@pytest.mark.parametrize("slope", [(0.0, 0.0), (0.01, -0.02)])
@pytest.mark.parametrize("height_m", [0.35, 1.2, 2.1])
def test_height_and_tilt_are_found_within_their_sigmas(height_m: float, slope: tuple[float, float]) -> None:
    rng = np.random.default_rng(1)
    parts = [plane(1500, rng, height_m, slope), walls(4000, rng, low_m=-height_m)]
    found = fit_floor(*noisy(np.vstack(parts), rng))
    assert found is not None
    floor = found.floor
    assert abs(floor.height_m - height_m) < 2 * floor.sigma_m < 0.06
    assert np.hypot(floor.a - slope[0], floor.b - slope[1]) < 2 * floor.sigma_rad < np.deg2rad(2)


def test_a_tilt_beyond_the_prior_is_drawn_towards_it() -> None:
    rng = np.random.default_rng(2)
    found = fit_floor(*noisy(np.vstack([plane(100, rng, slope=(0.05, 0.0)), walls(500, rng)]), rng))
    assert found is None or 0.0 < found.floor.a < 0.05


def test_a_table_above_the_floor_is_not_the_floor() -> None:
    rng = np.random.default_rng(3)
    table = plane(4000, rng, 0.5, azimuths=(-1.5, 1.5))
    found = fit_floor(*noisy(np.vstack([plane(800, rng), walls(2000, rng), table]), rng))
    assert found is not None and abs(found.floor.height_m - HEIGHT_M) < 0.04


@pytest.mark.parametrize(
    "points",
    [
        lambda rng: walls(4000, rng),
        lambda rng: plane(2000, rng, azimuths=(0.0, 1.5)),
        lambda rng: plane(10, rng),
        lambda rng: np.zeros((0, 3)),
        lambda rng: plane(2000, rng) * [1, 1, -1],
    ],
    ids=["walls only", "in a quarter of the directions", "few", "none", "a ceiling"],
)
def test_without_a_floor_that_is_seen_there_is_none(points: object) -> None:
    rng = np.random.default_rng(4)
    assert common_floor(noisy(points(rng), rng) for _ in range(PAIRS)) is None  # type: ignore[operator]


def test_weak_evidence_of_pairs_adds_up() -> None:
    rng = np.random.default_rng(5)
    pairs = [noisy(np.vstack([plane(90, rng), walls(4000, rng)]), rng) for _ in range(PAIRS)]
    floor = common_floor(pairs)
    assert common_floor(pairs[:1]) is None and floor is not None and abs(floor.height_m - HEIGHT_M) < 0.03


def test_pairs_that_contradict_one_another_show_no_floor() -> None:
    rng = np.random.default_rng(6)
    heights_m = [0.8 + 0.1 * (k % 5) for k in range(PAIRS)]
    seen = [np.vstack([plane(1500, rng, height_m), walls(500, rng, low_m=-height_m)]) for height_m in heights_m]
    assert common_floor(noisy(points, rng) for points in seen) is None


def test_the_level_frame_has_the_floor_at_zero() -> None:
    view, floor = np.array([0.1, 0.2, 0.5]), Floor(HEIGHT_M, 0.02, -0.03)
    T = floor.T_floor_base(view)
    on_floor = plane(50, np.random.default_rng(7), slope=(0.02, -0.03)) + view
    assert se3.is_rigid(T) and np.abs(se3.apply(T, on_floor)[:, 2]).max() < 1e-12
    np.testing.assert_allclose(se3.apply(T, np.zeros((1, 3)))[0, :2], 0.0, atol=1e-12)
    np.testing.assert_allclose(Floor(HEIGHT_M).T_floor_base(view), se3.transform(np.eye(3), [0, 0, HEIGHT_M - 0.5]))
