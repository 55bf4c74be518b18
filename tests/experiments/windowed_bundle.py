"""Bundle adjustment of a window of keyframes against today's odometry.

`python -m tests.experiments.windowed_bundle FOLDER[:DEG] ...`: folders of `python -m tests.simulation`; DEG rotates the
upper camera of the rig about a random axis. Whenever odometry adds a keyframe, the keyframes in its map, their
landmarks and all views of these are adjusted (Gauss-Newton, points eliminated by the Schur complement, Cauchy weights;
the oldest keyframe stays). Two rows a log: the motion over the window, and the path of all keyframes, joined of the
motions between the two oldest keyframes of each window, which have been adjusted most often.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np

import omnid
from calib import se3
from calib.models.camera import Array
from calib.rig_file import read_rig
from omnid.core.odometry.landmarks import LandmarkStore
from omnid.core.odometry.pose_estimation import StereoModel
from omnid.core.stereo.triangulation import view, view_jacobian
from omnid.formats.tum import read_tum
from tests.benchmark.places import disturbed

SIGMA_PX, CAUCHY = 0.1, 2.0  # noise of a view, and the error in sigmas from which its weight falls
STEPS: Final = 6
LEAST_LANDMARKS: Final = 30  # that are seen in two keyframes


@dataclass(frozen=True, slots=True, eq=False)
class Window:
    """Poses of keyframes by seq, points (N, 3) in odom, and views (M, 3) of points (rows) in keyframes (rows)."""

    seqs: list[int]
    T: Array
    points: Array
    of_point: Any
    of_keyframe: Any
    views: Array


def window_of(store: LandmarkStore) -> Window | None:
    """Return the window of what odometry keeps; None where too little is seen twice."""
    seqs, seen = sorted(store.keyframes), store.observations
    at = {seq: n for n, seq in enumerate(seqs)}
    usable = np.isin(seen.keyframe, seqs) & np.isfinite(seen.views).all(axis=1) & np.isin(seen.landmark, store.table.id)
    ids, row, count = np.unique(seen.landmark[usable], return_inverse=True, return_counts=True)
    twice = count[row] > 1
    kept, row = np.unique(row[twice], return_inverse=True)
    if len(seqs) < 3 or len(kept) < LEAST_LANDMARKS:
        return None
    points = store.table.points[np.searchsorted(store.table.id, ids[kept])]
    of_keyframe = np.array([at[seq] for seq in seen.keyframe[usable][twice].tolist()])
    return Window(seqs, np.array([store.keyframes[seq].T_odom_rect for seq in seqs]), points, row, of_keyframe,
                  seen.views[usable][twice])


def adjusted(window: Window, model: StereoModel) -> Array:
    """Return the poses (K, 4, 4) of the keyframes after the adjustment, T exp(xi)."""
    T, points, free = window.T.copy(), window.points.copy(), 6 * (len(window.T) - 1)
    for _ in range(STEPS):
        inverse = se3.inverse(T)[window.of_keyframe]
        local = (inverse[:, :3, :3] @ points[window.of_point][:, :, None])[:, :, 0] + inverse[:, :3, 3]
        error = (window.views - view(local, model.cylinder, model.baseline_m)) / SIGMA_PX
        error[:, 0] = model.cylinder.wrap(SIGMA_PX * error[:, 0]) / SIGMA_PX
        root = 1 / np.sqrt(1 + (error**2).sum(axis=1) / CAUCHY**2 / 3)
        J = root[:, None, None] * view_jacobian(local, model.cylinder, model.baseline_m) / SIGMA_PX
        by_pose = np.concatenate([-J, J @ se3.hat(local)], axis=2)  # of local = exp(-xi) T^-1 X
        by_point, e = J @ inverse[:, :3, :3], root[:, None] * error
        # Normal equations; W (K, N, 6, 3) joins poses and points, each of which has a block of its own in V.
        H, b = np.zeros((len(T), 6, 6)), np.zeros((len(T), 6))
        V, c = np.tile(1e-6 * np.eye(3), (len(points), 1, 1)), np.zeros((len(points), 3))
        W = np.zeros((len(T), len(points), 6, 3))
        np.add.at(H, window.of_keyframe, np.swapaxes(by_pose, 1, 2) @ by_pose)
        np.add.at(b, window.of_keyframe, (np.swapaxes(by_pose, 1, 2) @ e[:, :, None])[:, :, 0])
        np.add.at(V, window.of_point, np.swapaxes(by_point, 1, 2) @ by_point)
        np.add.at(c, window.of_point, (np.swapaxes(by_point, 1, 2) @ e[:, :, None])[:, :, 0])
        np.add.at(W, (window.of_keyframe, window.of_point), np.swapaxes(by_pose, 1, 2) @ by_point)
        WV = W @ np.linalg.inv(V)
        S = -np.einsum("anij,bnkj->aibk", WV, W, optimize=True)
        for k in range(len(T)):
            S[k, :, k] += H[k]
        right = b - np.einsum("anij,nj->ai", WV, c)
        S = S.reshape(6 * len(T), 6 * len(T))[6:, 6:] + 1e-9 * np.eye(free)
        xi = np.concatenate([np.zeros(6), np.linalg.solve(S, right.ravel()[6:])]).reshape(-1, 6)
        step = c - np.einsum("anij,ai->nj", W, xi)
        points += np.linalg.solve(V, step[:, :, None])[:, :, 0]
        T = T @ se3.exp(xi)
    return T


def rows(folder: Path, degrees: float) -> Iterator[str]:
    """Yield the rows of a log."""
    rig, truth = disturbed(read_rig(folder / "rig.toml"), degrees, 1), read_tum(folder / "truth.txt").T
    found: list[tuple[Window, Array]] = []
    untouched = LandmarkStore.add_keyframe

    def add_keyframe(self: LandmarkStore, *args: Any, **named: Any) -> Any:
        window = window_of(self)
        if window is not None:
            found.append((window, adjusted(window, self._model)))
        return untouched(self, *args, **named)

    LandmarkStore.add_keyframe = add_keyframe  # type: ignore[method-assign]
    try:
        omnid.replay(folder / "log.mcap", rig, overrides=["stereo.rig_check=off"])
    finally:
        LandmarkStore.add_keyframe = untouched  # type: ignore[method-assign]
    T_true = truth @ se3.inverse(read_rig(folder / "rig.toml").T_rect_rig)
    over = [[_error_m(T[0], T[-1], T_true[[window.seqs[0], window.seqs[-1]]]) for T in (window.T, after)]
            for window, after in found]
    name = f"{folder.name}, {degrees:g}°"
    before, now = 1e3 * np.sqrt((np.array(over) ** 2).mean(axis=0))
    size = np.median([len(window.seqs) for window, _ in found])
    table = {f"motion over a window of {size:g} keyframes, RMS": (before, now)} | _joined_ends(found, T_true)
    for label, (odometry_mm, adjusted_mm) in table.items():
        yield (f"| {name} | {label} | {len(found)} | {odometry_mm:.2f} mm | {adjusted_mm:.2f} mm "
               f"| {adjusted_mm / odometry_mm:.2f} |")


def _joined_ends(found: list[tuple[Window, Array]], T_true: Array) -> Mapping[str, tuple[float, float]]:
    """Return the largest and the last error [mm] of the path of the oldest pairs, by odometry and adjusted."""
    motions = {window.seqs[0]: (window.seqs[1], [se3.inverse(T[0]) @ T[1] for T in (window.T, after)])
               for window, after in found}
    seq = min(motions)
    first, errors = T_true[seq], []
    T = [np.eye(4), np.eye(4)]
    while seq in motions:
        seq, between = motions[seq]
        T = [a @ b for a, b in zip(T, between, strict=True)]
        truth = se3.inverse(first) @ T_true[seq]
        errors.append([1e3 * float(np.linalg.norm((one - truth)[:3, 3])) for one in T])
    largest, last = np.max(errors, axis=0), errors[-1]
    return {"joined path, largest error": (largest[0], largest[1]), "joined path, at its end": (last[0], last[1])}


def _error_m(a: Array, b: Array, T_true: Array) -> float:
    """Return the error of the motion from pose a to pose b."""
    return float(np.linalg.norm((se3.inverse(a) @ b - se3.inverse(T_true[0]) @ T_true[1])[:3, 3]))


def main() -> None:
    """Print the table."""
    print("| log, rig | | windows | odometry | adjusted | ratio |\n|---|---|---|---|---|---|")
    for word in sys.argv[1:]:
        folder, _, degrees = word.partition(":")
        for row in rows(Path(folder), float(degrees or 0)):
            print(row, flush=True)


if __name__ == "__main__":
    main()
