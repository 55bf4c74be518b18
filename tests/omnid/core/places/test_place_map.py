"""The map of places: what leaves it within its bounds, its landmarks and grid; pose graphs with truth."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
import pytest
from numpy.typing import NDArray

from calib import se3
from calib.panorama import Cylinder
from omnid.core.mapping.scan_grid import FREE, OCCUPIED
from omnid.core.places.place_map import Link, PlaceFeatures, PlaceKeyframe, PlaceMap, PlaceRig
from omnid.core.places.place_views import grid, landmarks
from omnid.core.places.pose_graph import PoseEdges, PoseGraphResult, optimise
from omnid.core.stereo.triangulation import view
from tests.omnid.core.mapping.rooms import OPEN, box, pose, scan_of


def keyframe(number: int, features: int = 10) -> PlaceKeyframe:
    """Return a keyframe that has seen nothing."""
    return PlaceKeyframe(
        number,
        0,
        number,
        np.eye(4),
        np.eye(6),
        np.zeros((16, 128), np.int8),
        np.full(360, np.nan, np.float16),
        np.zeros(360, np.float16),
        PlaceFeatures(np.zeros((features, 128), np.uint8), np.zeros((features, 3), np.float32)),
    )


def bent_way(number: float) -> np.ndarray:
    """Return a pose on a bent path."""
    return se3.exp([number, 0.3 * number, 0, 0, 0, 0.1 * number])


def link(a: int, b: int, inliers: int = 0) -> Link:
    """Return the exact edge between two keyframes."""
    return Link(a, b, se3.inverse(bent_way(a)) @ bent_way(b), 1e-4 * np.eye(6), inliers)


def chain(count: int, **bounds: int) -> PlaceMap:
    """Return a map of keyframes one after the other."""
    places = PlaceMap(**bounds)
    for number in range(count):
        places.add(keyframe(number), bent_way(number), link(number - 1, number) if number else None)
    return places


def test_a_full_map_drops_the_keyframe_that_is_nearest_to_others() -> None:
    places = PlaceMap(max_keyframes=4)
    for number, x in enumerate((0.0, 1.0, 1.1, 2.0, 3.0)):
        places.add(keyframe(number), bent_way(x))
    assert list(places.keyframes) == [0, 2, 3, 4] and set(places.poses) == set(places.keyframes)


def test_the_parts_of_a_map_are_those_that_links_join() -> None:
    places = chain(5)
    places.links = [link(0, 1), link(3, 4), link(4, 0, inliers=30)]
    assert places.parts() == [[0, 1, 3, 4], [2]]
    places.drop(4)
    assert places.parts() == [[0, 1, 3], [2]], "its links go on to its neighbour"


CYLINDER = Cylinder(1200, 400, 150.0)
# The rig stands 0.5 m above the base and looks to its left.
RIG = PlaceRig(CYLINDER, 0.25, pose(0, 0, 0.2), se3.transform(se3.rotation_exp([0, 0, np.pi / 2]), [0, 0, 0.5]), "ab12")
ROOM = box((-3.0, -2.0), (4.0, 2.5))
LANDMARK = np.array([[2.0, 1.0, 0.28]])  # in the map's rectified frame


def seeing_keyframe(id: int, T: np.ndarray, session: int = 0) -> PlaceKeyframe:
    views = view(se3.apply(se3.inverse(T), LANDMARK), CYLINDER, RIG.baseline_m).astype(np.float32)
    features = PlaceFeatures(np.zeros((1, 128), np.uint8), views)
    scan = scan_of(ROOM, T).astype(np.float16)
    small, free_m = np.zeros((16, 128), np.int8), OPEN.astype(np.float16)
    return PlaceKeyframe(id, session, 10**9 * id, T, np.eye(6), small, scan, free_m, features)


def places(count: int = 6) -> PlaceMap:
    found = PlaceMap()
    for id in range(count):
        T = pose(0.3 * id, 0.1, 0.2 * id)
        link = Link(id - 1, id, se3.inverse(found.poses[id - 1]) @ T, np.eye(6)) if id else None
        found.add(seeing_keyframe(id, T), T, link)
    return found


def test_landmarks_of_several_keyframes_become_one_in_the_axes_of_the_base() -> None:
    points = landmarks(places(), RIG, 0.05)
    assert len(points.xyz) == 1 and points.frames[0] == 6
    np.testing.assert_allclose(points.xyz, se3.apply(RIG.T_base_rect, LANDMARK), atol=0.01)


def test_the_grid_shows_the_room_where_the_base_sees_it() -> None:
    found = grid(places(), RIG, 0.05)
    corners = se3.apply(RIG.T_base_rect, np.array([[4.0, 0.0, 0], [0.5, 0.2, 0]]))
    cells = np.floor((corners[:, :2] - found.corner) / 0.05).astype(int)
    around = found.cells[cells[0, 1] - 1 : cells[0, 1] + 2, cells[0, 0] - 1 : cells[0, 0] + 2]
    assert OCCUPIED in around and found.cells[cells[1, 1], cells[1, 0]] == FREE


Array = NDArray[np.float64]

STEP_M = 0.3
SIGMA_STEP = np.array([3e-3, 3e-3, 1e-3, 2e-4, 2e-4, 1e-3])  # m and rad, of each step of the odometry
SIGMA_LOOP = np.array([0.01, 0.01, 0.01, 2e-3, 2e-3, 2e-3])


@dataclass(frozen=True)
class Laps:
    """Poses, measurements and which loops are right."""

    truth: Array  # (N, 4, 4)
    odometry: PoseEdges
    loops: PoseEdges
    right: NDArray[np.bool_]  # (L,)

    @property
    def edges(self) -> PoseEdges:
        """All edges: those of the odometry, then the loops."""
        return joined(self.odometry, self.loops)

    @property
    def start(self) -> Array:
        """Return the poses (N, 4, 4) of the odometry alone."""
        poses = [np.eye(4)]
        for step in self.odometry.T_a_b:
            poses.append(poses[-1] @ step)
        return np.array(poses)

    def error_m(self, T: Array) -> float:
        """Return the root mean square of the position errors, all in the frame of the first node."""
        return float(np.sqrt(((T[:, :3, 3] - self.truth[:, :3, 3]) ** 2).sum(axis=1).mean()))


def laps(seed: int, nodes: int, per_lap: int, loops: int, wrong: float) -> Laps:
    """Return laps along a rectangle; `wrong` is the share of loops whose pose has nothing to do with the truth."""
    rng = np.random.default_rng(seed)
    truth = np.array([np.eye(4) for _ in range(nodes)])
    for k in range(1, nodes):
        turn = np.pi / 2 if k % (per_lap // 4) == 0 else 0.0
        truth[k] = truth[k - 1] @ se3.exp([STEP_M, 0, 0, 0, 0, 0]) @ se3.exp([0, 0, 0, 0, 0, turn])
    a = np.arange(nodes - 1)
    odometry = measured(rng, truth, a, a + 1, SIGMA_STEP)
    first = rng.integers(0, nodes - per_lap, loops)
    laps_later = np.array([rng.integers(1, (nodes - 1 - k) // per_lap + 1) for k in first], np.intp)
    second = np.clip(first + per_lap * laps_later + rng.integers(-2, 3, loops), 0, nodes - 1)
    right = np.arange(loops) >= round(wrong * loops)
    found = measured(rng, truth, first, second, SIGMA_LOOP, is_loop=True)
    xi = np.concatenate(
        [rng.uniform(-1, 1, (loops, 3)), rng.uniform(-0.1, 0.1, (loops, 2)), rng.uniform(-np.pi, np.pi, (loops, 1))],
        axis=1,
    )
    elsewhere = np.array([rng.integers(0, nodes) for _ in range(loops)], np.intp)
    b = np.where(right, second, elsewhere)
    T = np.where(right[:, None, None], found.T_a_b, se3.exp(xi))
    pairs = np.column_stack([first, b])
    return Laps(truth, odometry, PoseEdges(pairs, T, found.covariance, np.ones(loops, bool)), right)


def measured(
    rng: np.random.Generator,
    truth: Array,
    a: NDArray[np.intp],
    b: NDArray[np.intp],
    sigma: Array,
    is_loop: bool = False,
) -> PoseEdges:
    """Return edges with noise of those standard deviations (6,)."""
    exact = se3.inverse(truth[a]) @ truth[b]
    covariance = np.broadcast_to(np.diag(sigma**2), (len(a), 6, 6)).copy()
    noisy = exact @ se3.exp(sigma * rng.normal(size=(len(a), 6)))
    return PoseEdges(np.column_stack([a, b]), noisy, covariance, np.full(len(a), is_loop))


def joined(*parts: PoseEdges) -> PoseEdges:
    """Return all edges, one part after the other."""
    return PoseEdges(*(np.concatenate([getattr(part, item.name) for part in parts]) for item in fields(PoseEdges)))


def without(edges: PoseEdges, row: int) -> PoseEdges:
    """Return the edges but one."""
    return PoseEdges(*(np.delete(getattr(edges, item.name), row, axis=0) for item in fields(PoseEdges)))


def loops_of(found: PoseGraphResult) -> NDArray[np.bool_]:
    """Return flags of the loops of a run of `laps` that were accepted."""
    odometry_edges = len(found.poses) - 1
    return found.accepted[odometry_edges:]


@pytest.mark.parametrize("seed", [1, 2])
def test_loops_take_most_of_the_drift_away_and_wrong_ones_do_not_count(seed: int) -> None:
    run = laps(seed, nodes=400, per_lap=100, loops=60, wrong=0.1)
    found = optimise(run.start, run.edges)
    assert not loops_of(found)[~run.right].any()
    assert loops_of(found)[run.right].mean() > 0.95
    assert run.error_m(found.poses) < 0.3 * run.error_m(run.start)


def test_wrong_loops_that_agree_with_each_other_do_not_bend_the_odometry() -> None:
    """As in two corridors that look the same, 15 m apart."""
    run = laps(4, nodes=400, per_lap=100, loops=30, wrong=0.0)
    pairs = np.column_stack([np.arange(5, 25), np.arange(55, 75)])
    twins = PoseEdges(
        pairs, np.tile(np.eye(4), (20, 1, 1)), np.tile(np.diag(SIGMA_LOOP**2), (20, 1, 1)), np.ones(20, bool)
    )
    accepted = loops_of(optimise(run.start, joined(run.edges, twins)))
    assert not accepted[30:].any()
    assert accepted[:30].mean() > 0.9


def test_the_covariance_of_the_last_node_is_that_of_its_error() -> None:
    """The squared Mahalanobis distance of the last pose is chi-squared with six degrees of freedom: mean 6."""
    squared = []
    for seed in range(25):
        run = laps(100 + seed, nodes=60, per_lap=20, loops=6, wrong=0.0)
        found = optimise(run.start, run.edges)
        error = se3.log(se3.inverse(found.poses[-1]) @ run.truth[-1])
        squared.append(error @ np.linalg.solve(found.covariance, error))
    assert 6 - 4 * np.sqrt(12 / 25) < np.mean(squared) < 6 + 4 * np.sqrt(12 / 25)


def test_fixed_nodes_stay_and_the_others_move_to_them() -> None:
    """A saved map of 100 nodes is fixed; a second session, 5 m off, comes to it by its loops."""
    run = laps(7, nodes=200, per_lap=100, loops=30, wrong=0.0)
    fixed = np.arange(200) < 100
    start = run.truth.copy()
    start[100:] = se3.exp([5, 3, 0, 0, 0, 0.5]) @ start[100:]
    cut = without(run.odometry, 99)
    found = optimise(start, joined(cut, run.loops), fixed)
    np.testing.assert_array_equal(found.poses[:100], start[:100])
    assert np.isfinite(found.covariance).all()
    assert run.error_m(found.poses) < 0.05
