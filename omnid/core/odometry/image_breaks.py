"""Images that are whole, but not of one instant or of one geometry: torn, displaced, with lines missing or repeated.

Landmarks flow from one pair to the next as the step of the rig says, and what is left of their flow is noise, if the
images are right. With the flow d_i of landmark i in the panorama of a camera, less the flow that the step predicts,

    H0:  d_i = J_i x + noise                                     x (6,): error of the step
    H1:  d_i = J_i x + [i lies beyond the line] F_i a + noise    in one camera, or in both

F_i a is a shift and a turn in the raw image (its window or a mirror moved, lines repeat or are missing), or another
motion of the rig (what is beyond the line is of another image, or the rows are exposed one after another). Lines are
rows of the raw image; line 0 is the whole image. What moves in view, as people do, does not end at a raw line. H1 is
compared with H0 by the generalised likelihood ratio, robustly, with the Bayesian information criterion (Schwarz 1978).

The flow shows a displacement in the pair in which it begins, and once more where it ends: in between, the landmarks
that were seen since agree with it. So it stays until its opposite is seen. A torn image shows it whenever the rig
changes its motion; the evidence is summed up, and forgotten within seconds.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from calib import se3
from omnid.core.odometry.estimates import OdometryEstimate
from omnid.core.odometry.exposure_times import Exposure
from omnid.core.odometry.local_map import LocalMap
from omnid.core.odometry.motion_hypotheses import DECIDING_COST, LANDMARKS
from omnid.core.odometry.pose_estimation import CORRELATED, DAMPING, GAUSS_NEWTON_STEPS
from omnid.core.odometry.tracking import KltSettings, track
from omnid.core.stereo.triangulation import view, view_jacobian
from omnid.core.types.panorama import PaddedPanorama
from omnid.core.types.stereo_model import StereoModel

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]
Indices = NDArray[np.intp]

SIGMA_PX: Final = 0.2  # of a flow
OUTLIER_SQUARED: Final = 32.0  # squared distance, a sum of two squares, from which on a flow costs no more
MOST_SQUARED: Final = 25 * OUTLIER_SQUARED  # of noise of half a pixel; where it is larger, flows are displaced
# Share of the flows that no break displaces, of one camera or up to a line; least share of them on either side of a
# tear, and of what right images leave of them that it explains.
LEAST_SHARE: Final = 0.2
# Cost of a landmark (`PoseEstimate.cost`) whose view has the noise that is expected: the mean of the Cauchy kernel's.
RIGHT_COST: Final = 0.31
# Part of a new pair in the mean of the costs: after some five pairs what is usual is known. By a mean of one second a
# pair of the first seconds costs a quarter more.
FOLLOWED: Final = 0.2
LINES: Final = 12  # equal parts of the raw image, at whose borders lines are tried
LEAST: Final = 8  # flows on either side of a line in the cameras of a break
LEAST_PX: Final = 0.5  # least displacement of a part of an image against the rest: less harms no pose
# Time constant with which evidence of tears decays, as vehicles change their motion more often.
MEMORY_S: Final = 1.0
CAMERAS: Final = ("lower", "upper")
SETS: Final = ((0,), (1,), (0, 1))  # cameras whose images are broken in one way


class RawImage:
    """Where the raw image of a camera shows the pixels of its panorama."""

    def __init__(self, u: NDArray[np.float32], v: NDArray[np.float32], size: tuple[int, int]) -> None:
        """u, v (H, W): raw column and row of each pixel, -1: none; size: columns and rows of the raw image."""
        self._maps, self.size = (u, v), size

    def at(self, pixels: Array) -> tuple[Array, Array]:
        """Return raw pixels (N, 2) of pixels (N, 2), NaN: none, and the derivatives (N, 2, 2) of pixels by raw ones."""
        height, width = self._maps[0].shape
        column, row = np.rint(pixels).astype(np.intp).T
        column, row = np.clip(column, 2, width - 3), np.clip(row, 2, height - 3)
        raw = np.column_stack([table[row, column] for table in self._maps]).astype(float)
        across = np.column_stack([table[row, column + 2] - table[row, column - 2] for table in self._maps]) / 4.0
        down = np.column_stack([table[row + 2, column] - table[row - 2, column] for table in self._maps]) / 4.0
        by_pixel = np.stack([across, down], axis=2)
        is_shown = (raw >= 0).all(axis=1) & (np.abs(np.linalg.det(by_pixel)) > 1e-3)
        by_raw = np.linalg.inv(np.where(is_shown[:, None, None], by_pixel, np.eye(2)))
        return np.where(is_shown[:, None], raw, np.nan), by_raw


class Break(NamedTuple):
    """A break of the images of one camera, or of both, at a pair."""

    is_torn: bool  # by another motion of the rig; else displaced
    cameras: tuple[int, ...]  # 0: lower, 1: upper
    line_px: int  # row of the raw image; 0: the whole image
    is_before: bool  # what is before the line is displaced, and not what is beyond
    amount: Array  # (3,) raw px and turn, rad, of the first camera of a displacement
    angle_rad: float  # by which what is displaced is off in view, mean
    gain: float  # logarithm of the likelihood ratio, less the cost of the parameters

    def words(self, pairs: int = 1) -> str:
        """Return what a break was that so many pairs showed, and what to do."""
        cameras = " and the ".join(CAMERAS[camera] for camera in self.cameras)
        cameras += " cameras" if len(self.cameras) > 1 else " camera"
        shown = "1 pair shows" if pairs == 1 else f"{pairs} pairs show"
        if self.is_torn:
            return (
                f"images of the {cameras} are torn at row {self.line_px}: what is below is of another moment than what "
                f"is above, as {shown}; check bandwidth, buffers and a rolling shutter, poses were degraded"
            )
        part = f" {'above' if self.is_before else 'below'} row {self.line_px}" if self.line_px else ""
        u, v, turn = self.amount
        return (
            f"images of the {cameras} were displaced by {u:+.1f}, {v:+.1f} px{part}, turned by "
            f"{math.degrees(turn):+.1f} deg, as {shown}: the rig does not fit them; check the mirror, the sensor's "
            "window and the driver, poses were degraded"
        )


class _View(NamedTuple):
    """A pair with its pose."""

    pair: tuple[PaddedPanorama, PaddedPanorama]
    T_odom_rect: Array
    exposure: Exposure
    step: Array  # (6,) that led to it


class Flow(NamedTuple):
    """Flows of landmarks that are not explained by the step, in standard deviations; rows of all cameras."""

    y: Array  # (N, 2)
    by_step: Array  # (N, 2, 6) derivatives by the step's error
    by_raw: Array  # (N, 2, 3) by a shift and a turn of the raw image
    camera: Indices  # (N,)
    row: Array  # (N,) of the raw image, as a fraction of it
    px: Array  # (N,) standard deviations


class ImageBreaks:
    """Follows the breaks of a run from pair to pair.

    covariance (6, 6) [t; r]: what breaks add to that of the pose; fault: how the images of the last pair are broken, in
    words, empty: they are whole.
    """

    def __init__(self, model: StereoModel, raws: tuple[RawImage, RawImage]) -> None:
        self._model, self._raws = model, raws
        self.covariance, self.fault = np.zeros((6, 6)), ""
        self._torn = 0.0  # gains of tears, less those forgotten
        self._last: _View | None = None
        self._tear: Break | None = None  # the last one
        self._open: list[Break] = []  # displacements that have not ended
        self._usual_cost = 0.0  # of a landmark in whole images: none is known yet, so that the first pairs are tested
        # The first break of each kind and cameras, and the number of pairs that showed one.
        self._found: dict[tuple[bool, tuple[int, ...]], tuple[Break, int]] = {}

    @property
    def words(self) -> list[str]:
        """One line for each kind of break and the cameras that showed it."""
        return [first.words(pairs) for first, pairs in self._found.values()]

    def add(
        self,
        pair: tuple[PaddedPanorama, PaddedPanorama],
        estimate: OdometryEstimate,
        exposure: Exposure,
        local_map: LocalMap,
        dt_s: float,
        cost: tuple[float, int] | None,
    ) -> None:
        """Use a pair with its pose, dt_s after the one before.

        cost: mean of the landmarks in view, and their number, None: no pose was found. A break costs at least as much
        as it must explain to be believed: where the views fit as usual there is none, and no flow is measured.
        """
        # 1. The break that the flow shows.
        last, found = self._last, None
        step = np.zeros(6) if last is None else se3.log(se3.inverse(last.T_odom_rect) @ estimate.T_odom_rect)
        self._last = now = _View(pair, estimate.T_odom_rect, exposure, step)
        is_broken = self._torn > DECIDING_COST or bool(self._open)
        is_usual = cost is not None and cost[1] * (cost[0] - self._usual_cost) < DECIDING_COST and not is_broken
        # A pose that was only predicted says too little about the motion between several exposures.
        is_known = exposure.times.is_at_once or (cost is not None and exposure.is_known)
        if last is not None and dt_s > 0 and is_known and last.exposure.is_known and not is_usual:
            flow = self._flow(last, now, local_map)
            found = None if flow is None else likeliest_break(flow, self._raws, self._model.cylinder.focal_px)
        if cost is not None and found is None:
            usual = self._usual_cost + FOLLOWED * (cost[0] - self._usual_cost)
            self._usual_cost = min(usual, RIGHT_COST)  # a run whose images are broken from the start is not usual
        # 2. What is broken now.
        self._torn *= math.exp(-dt_s / MEMORY_S)
        if found is not None:
            first, pairs = self._found.get((found.is_torn, found.cameras), (found, 0))
            self._found[found.is_torn, found.cameras] = first, pairs + 1
            if found.is_torn:
                self._torn, self._tear = self._torn + found.gain, found
            else:
                ended = [each for each in self._open if _is_undone(each, found)]
                self._open = [each for each in self._open if each not in ended] + [found] * (not ended)
        is_torn = self._torn > DECIDING_COST
        shown = found or (self._tear if is_torn else None) or (self._open[-1] if self._open else None)
        self.fault = "" if shown is None else shown.words()
        # 3. A torn image shows the rig up to an image too early, and landmarks are misplaced by as much. A displaced
        #    one turns directions, and moves the rig by as much of the landmarks' range.
        if last is None or (shown is None and not self.covariance.any()):
            return
        A = se3.adjoint(se3.exp(-step))
        self.covariance = A @ self.covariance @ A.T
        if is_torn:
            self.covariance = self.covariance + np.outer(step, step) + np.outer(last.step, last.step)
        if found is not None:
            of_angle = np.diag(np.repeat([estimate.distance_m**2, 1.0], 3))
            self.covariance = self.covariance + found.angle_rad**2 * of_angle

    def _flow(self, last: _View, now: _View, local_map: LocalMap) -> Flow | None:
        """Return the flows of the landmarks that the map shows in the last pair, None: too few of them are found."""
        cylinder, baseline_m = self._model.cylinder, self._model.baseline_m
        landmarks, _ = local_map.visible(last.T_odom_rect)
        landmarks = landmarks[:: max(1, -(-len(landmarks) // LANDMARKS))]
        covariance = local_map.table.covariance[landmarks]
        before, after = (
            se3.apply(se3.inverse(each.T_odom_rect), local_map.table.points[landmarks]) for each in (last, now)
        )
        shifts = last.exposure.shift(before), now.exposure.shift(after)
        views = tuple(view(points, cylinder, baseline_m) for points in (before, after))
        J_before, J_now = (view_jacobian(points, cylinder, baseline_m) for points in (before, after))
        of_step = np.concatenate([np.broadcast_to(-np.eye(3), (len(after), 3, 3)), se3.hat(after)], axis=2)
        of_point = J_now @ now.T_odom_rect[:3, :3].T - J_before @ last.T_odom_rect[:3, :3].T
        parts, sought = [], 0
        for camera, raw_image in enumerate(self._raws):
            # 1. Landmarks that both pairs show, and where they are instead of where the step puts them. They are
            #    tracked from there, else as if the rig had stood, as torn images show it.
            own = [0, 1 + camera]
            started, ended = ((each.lower, each.upper)[camera] for each in shifts)
            start, end = views[0][:, own] - started, views[1][:, own] - ended
            raw, by_raw = raw_image.at(end)
            rows = np.flatnonzero(np.isfinite(raw).all(axis=1) & cylinder.shows(start[:, 0]))
            sought += len(rows)
            there, found = track(last.pair[camera], now.pair[camera], start[rows], end[rows], KltSettings())
            again, found_again = track(last.pair[camera], now.pair[camera], start[rows], start[rows], KltSettings())
            there[~found], found = again[~found], found | found_again
            rows, d = rows[found], there[found] - end[rows[found]]
            d[:, 0] = cylinder.wrap(d[:, 0])
            # 2. Derivatives, in standard deviations.
            noise = np.einsum("nij,njk,nik->ni", of_point[rows][:, own], covariance[rows], of_point[rows][:, own])
            noise += shifts[1].variance(now.exposure.motion)[rows][:, [0, 1] if camera == 0 else [3, 2]]
            px = np.sqrt(SIGMA_PX**2 + noise.mean(axis=1))
            J, shift = J_now[rows][:, own] @ of_step[rows] / px[:, None, None], by_raw[rows] / px[:, None, None]
            size = np.array(raw_image.size)
            arm = raw[rows] - (size - 1) / 2
            turn = shift @ np.column_stack([-arm[:, 1], arm[:, 0]])[:, :, None]
            of_raw = np.concatenate([shift, turn], axis=2)
            parts.append((d / px[:, None], J, of_raw, np.full(len(rows), camera), raw[rows, 1] / size[1], px))
        flow = Flow(*(np.concatenate(part) for part in zip(*parts, strict=True)))
        return flow if len(flow.y) >= max(3 * LEAST, sought / 2) else None


def likeliest_break(flow: Flow, raws: tuple[RawImage, RawImage], focal_px: float) -> Break | None:
    """Return the likeliest break that flows show beyond doubt; None: there is none."""
    y, steps, count = flow.y, flow.by_step, len(flow.y)
    # 1. H0: no error of the step, or that of all flows; a step that is wrong must explain much more to be believed.
    lefts = [y - steps @ _robust(steps, y, weight) for weight in (_weight(y), np.ones(count))]
    squares = [(left**2).sum(axis=1) for left in lefts]
    best = int(2 * np.minimum(squares[1], MOST_SQUARED).sum() < np.minimum(squares[0], MOST_SQUARED).sum())
    whole, off = squares[best], lefts[best]
    # The noise of flows is at least that expected: so many sums of two squares of unit variance are smaller.
    scale = np.clip(
        np.quantile(whole, LEAST_SHARE) / (-2 * math.log(1 - LEAST_SHARE)), 1.0, MOST_SQUARED / OUTLIER_SQUARED
    )
    outlier, unit = OUTLIER_SQUARED * scale, 2 * scale * CORRELATED
    all_gain = float(np.minimum(whole, outlier).sum()) / unit
    if all_gain < DECIDING_COST + _cost(3, count):
        return None  # no break explains more than all that is left
    # 2. H1, of all cameras, kinds, lines and sides. The fit begins with what is beyond the line, and with the step that
    #    explains the rest.
    is_off = whole >= outlier
    most_off = int(np.bincount(flow.camera[is_off], minlength=2).argmax())
    found: Break | None = None
    for cameras in SETS:
        masks = [flow.camera == camera for camera in cameras]
        own = np.logical_or.reduce(masks)
        for is_torn in (False, True):
            columns = (
                steps if is_torn else np.concatenate([flow.by_raw * each[:, None, None] for each in masks], axis=2)
            )
            least = LEAST_SHARE * own.sum() if is_torn else LEAST
            for line, is_before in ((n / LINES, side) for n in range(LINES) for side in (False, True)):
                beyond = own & ((flow.row >= line) != is_before)
                is_whole = line == 0 and not is_before and not is_torn and cameras != (1 - most_off,)
                if not is_whole and min(beyond.sum(), (own & ~beyond).sum()) < least:
                    continue
                A = np.concatenate([steps, columns * beyond[:, None, None]], axis=2)
                solution = _robust(A, y, np.where(beyond, 1.0, _weight(off)))
                left = ((y - A @ solution) ** 2).sum(axis=1)
                gain = float((np.minimum(whole, outlier) - np.minimum(left, outlier)).sum()) / unit
                gain -= _cost(columns.shape[2], count)
                if gain < max(DECIDING_COST, LEAST_SHARE * all_gain * is_torn, 0.0 if found is None else found.gain):
                    continue
                amount = solution[6:]
                moved_px = np.linalg.norm(A[beyond][:, :, 6:] @ amount, axis=1) * flow.px[beyond]
                line_px, angle_rad = round(line * raws[cameras[0]].size[1]), float(moved_px.mean()) / focal_px
                if moved_px.mean() > LEAST_PX:
                    found = Break(is_torn, cameras, line_px, is_before, amount[:3], angle_rad, gain)
    return found


def _is_undone(one: Break, other: Break) -> bool:
    """True if the second displacement ends the first one."""
    if not set(one.cameras) & set(other.cameras):
        return False
    apart, *sizes = (float(np.linalg.norm(each[:2])) for each in (one.amount + other.amount, one.amount, other.amount))
    return apart < 0.5 * max(sizes)


def _cost(parameters: int, flows: int) -> float:
    """Return the penalty of a displacement with so many parameters by so many flows, and of the choice."""
    return 0.5 * parameters * math.log(2 * flows) + math.log(4 * LINES * len(SETS))


def _weight(left: Array) -> Array:
    """Return the weights (N,) of the Geman-McClure cost for what is left (N, 2)."""
    return np.asarray(1.0 / (1.0 + (left**2).sum(axis=1) / 4.0) ** 2)


def _robust(A: Array, y: Array, weight: Array) -> Array:
    """Return x (K,) that minimises the Geman-McClure cost of y - A x, A (N, 2, K), from weights (N,)."""
    x, size = np.zeros(A.shape[2], float), A.shape[2]
    for _ in range(GAUSS_NEWTON_STEPS):
        weighted = (weight[:, None, None] * A).reshape(-1, size)
        normal = weighted.T @ A.reshape(-1, size) + DAMPING * np.eye(size)
        x = np.linalg.solve(normal, weighted.T @ y.ravel()).astype(float)
        weight = _weight(y - A @ x)
    return x
