"""The acceptance drive: visits of the marks by standing and by times, errors of rounds, limits."""

from __future__ import annotations

import math
import re
from itertools import pairwise

import numpy as np
import pytest

from calib import se3
from omnid.errors import OmnidError
from omnid.formats.tum import Trajectory
from omnid.recordings.acceptance import accept, visits_at_times, visits_by_standing
from tests.simulation.paths import planar_poses

HZ, STAND, SPEED_M = 10, 40, 0.05  # poses a second, of a stand, metres between two poses
DISTANCE_M = 12.0


def drive(
    rounds: int = 3, scale: float = 1.0, drift_rad: float = 0.0, noise_m: float = 1e-3, wait: bool = False
) -> Trajectory:
    """Return a path from A to B and back, with a scale, a heading that drifts in each round, and a pause on the way."""
    along = np.arange(0, DISTANCE_M + 1e-9, SPEED_M)
    there = np.concatenate(
        [along[: len(along) // 2], [along[len(along) // 2]] * (50 if wait else 1), along[len(along) // 2 + 1 :]]
    )
    x = [np.zeros(STAND)]
    for _ in range(rounds):
        x += [there, np.full(STAND, DISTANCE_M), along[::-1], np.zeros(STAND)]
    way = np.concatenate(x)
    heading = drift_rad * np.linspace(0, rounds, len(way))
    noise = noise_m * np.random.default_rng(1).standard_normal((len(way), 2))
    poses = planar_poses(scale * np.column_stack([way * np.cos(heading), way * np.sin(heading)]) + noise, heading)
    stamps_ns = 1_700_000_000_000_000_000 + np.arange(len(way)) * (10**9 // HZ)
    return Trajectory(stamps_ns, se3.inverse(poses[0]) @ poses)


def test_the_marks_are_where_the_robot_stands() -> None:
    path = drive(wait=True)
    visits = visits_by_standing(path, DISTANCE_M)
    assert "".join(visit.mark for visit in visits) == "ABABABA"
    found = accept(path, visits, DISTANCE_M)
    assert len(found.rounds) == 3 and found.length_error_ratio == pytest.approx(0, abs=2e-4)
    assert found.rounds[0].way_m == pytest.approx(24.0, rel=0.02) and found.rounds[0].end_error_m < 2e-3
    assert found.repeatability_m < 2e-3 and found.faults(0.005) == []


def test_a_scale_is_the_error_of_lengths() -> None:
    path = drive(scale=1.02)
    found = accept(path, visits_by_standing(path, DISTANCE_M), DISTANCE_M)
    assert found.length_error_ratio == pytest.approx(0.02, abs=2e-4) and found.length_spread_ratio < 1e-3
    assert found.faults(0.005)[0].startswith("lengths are off by +2.00 %") and found.faults(0.02) == []


def test_lengths_that_are_right_in_the_mean_only_are_not_accepted() -> None:
    long, short = drive(rounds=1, scale=1.02), drive(rounds=1, scale=0.98)
    later_ns = long.stamps_ns[-1] - short.stamps_ns[0] + 10**9 // HZ
    path = Trajectory(
        np.concatenate([long.stamps_ns, short.stamps_ns + later_ns]), np.concatenate([long.T, long.T[-1] @ short.T])
    )
    found = accept(path, visits_by_standing(path, DISTANCE_M), DISTANCE_M)
    assert len(found.rounds) == 2 and found.length_error_ratio == pytest.approx(0, abs=2e-4)
    (line,) = found.faults(0.005)
    assert re.search(r"the worst by [+-]\d\.\d\d % from (A to B|B to A) in round [12], expected 0\.5 %", line)
    assert found.faults(0.02) == []


def test_a_drift_of_the_heading_is_seen_in_the_places_of_the_marks() -> None:
    path = drive(drift_rad=math.radians(2.0))
    found = accept(path, visits_by_standing(path, DISTANCE_M), DISTANCE_M)
    assert math.degrees(found.rounds[0].end_heading_rad) == pytest.approx(2.0, abs=0.4)
    assert 0.1 < found.repeatability_m < 0.5


def test_a_drive_that_ends_elsewhere_is_not_accepted() -> None:
    path = drive(rounds=1)
    T = path.T.copy()
    T[-60:, 1, 3] += np.linspace(0, 0.3, 60)
    T[-STAND:, 1, 3] = 0.3
    found = accept(Trajectory(path.stamps_ns, T), visits_at_times(path, [2.0, 30.0, 57.0]), DISTANCE_M)
    assert found.rounds[0].end_error_m == pytest.approx(0.3, abs=0.01) and math.isnan(found.repeatability_m)
    assert "round 1 ends 3" in found.faults(0.005)[-1]


def test_times_of_a_robot_that_drives_over_the_marks() -> None:
    path = drive(rounds=1, noise_m=0.0)
    # It passes B at STAND poses and 12 m; 20 ms later it is between two poses.
    visits = visits_at_times(path, [1.0, STAND / HZ + 6.02, 50.0])
    assert visits[1].T[0, 3] == pytest.approx(6.02 / 0.1 * SPEED_M, abs=1e-6)


@pytest.mark.parametrize("times_s", [[1.0, 2.0], [3.0, 2.0, 4.0], [0.0, 5.0, 1e4], [-1.0, 2.0, 3.0]])
def test_times_that_are_none_are_refused(times_s: list[float]) -> None:
    with pytest.raises(OmnidError, match=r"--marks: expected .* found"):
        visits_at_times(drive(rounds=1), times_s)


def test_a_wrong_distance_finds_no_round_and_says_what_it_found() -> None:
    with pytest.raises(OmnidError, match=r"found A at .* s; check --distance-m"):
        visits_by_standing(drive(), 5.0)


def with_stops(*stops_m: float) -> Trajectory:
    """Return a straight path from 0 that stands at 0 and at each of the places."""
    x = [np.zeros(STAND)]
    for start, end in pairwise((0.0, *stops_m)):
        x += [np.linspace(start, end, int(abs(end - start) / SPEED_M) + 1), np.full(STAND, end)]
    way = np.concatenate(x)
    return Trajectory(np.arange(len(way)) * (10**9 // HZ), planar_poses(np.column_stack([way, 0 * way]), 0 * way))


@pytest.mark.parametrize(
    ("stops_m", "mark"),
    [((10.5, 12.0, 0.0), "B"), ((12.0, 11.0, 0.0), "B"), ((12.0, 2.0, 0.0), "A"), ((1.0, 12.0, 0.0), "A")],
)
def test_a_wait_near_a_mark_is_not_taken_for_it(stops_m: tuple[float, ...], mark: str) -> None:
    with pytest.raises(OmnidError, match=rf"one place of mark {mark}, found stops .* s; give the times .*--marks"):
        visits_by_standing(with_stops(*stops_m), DISTANCE_M)


def test_a_robot_that_is_placed_twice_is_on_one_mark() -> None:
    visits = visits_by_standing(with_stops(0.1, 12.1, 12.0, 0.1), DISTANCE_M)
    assert [round(float(visit.T[0, 3]), 3) for visit in visits] == [0.1, 12.1, 0.1]
