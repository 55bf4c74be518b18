"""Images that are whole, but not of one instant or of one geometry: torn, displaced, with lines missing or twice.

Landmarks flow from one pair to the next as the step of the rig says, and what is left of their flow is noise, if the
images are right. With the flow d_i of landmark i in the panorama of a camera, less the flow that the step predicts,

    H0:  d_i = J_i x + noise                                     x (6,): error of the step
    H1:  d_i = J_i x + [i lies beyond the line] F_i a + noise    in one camera, or in both

F_i a is a shift and a turn of the raw image (its window or a mirror moved, lines repeat or are missing), or another
motion of the rig (what is beyond the line is of another image, as in torn ones). Lines are rows of the raw image. What
moves in view, as people do, does not end at a raw line. H1 is compared with H0 by the generalised likelihood ratio,
robustly, with the Bayesian information criterion (Schwarz 1978).

The flow shows a displacement in the pair in which it begins, and once more where it ends: in between, the landmarks
that were seen since agree with it. So it stays until its opposite is seen. A torn image shows it whenever the rig
changes its motion; the evidence is summed up, and forgotten within seconds.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from calib import se3
from omnid.core.odometry.estimates import OdometryEstimate
from omnid.core.odometry.exposure_times import Exposure
from omnid.core.odometry.line_times import CAMERAS, LAG_S, LEAST_PX, MEMORY_S, SETS, LineTimes, RawImage, camera_names
from omnid.core.odometry.local_map import LocalMap
from omnid.core.odometry.motion_hypotheses import DECIDING_COST
from omnid.core.odometry.plane_patches import WINDOW_PX, align, plane_templates
from omnid.core.odometry.pose_estimation import CORRELATED, DAMPING, GAUSS_NEWTON_STEPS, OUTLIER_SQUARED, VIEW, cost
from omnid.core.odometry.tracking import KltSettings, track
from omnid.core.stereo.triangulation import motion_jacobian, view
from omnid.core.types.panorama import PaddedPanorama
from omnid.core.types.stereo_model import StereoModel

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]
Indices = NDArray[np.intp]

MOST: Final = 160  # landmarks that are followed in each camera
SIGMA_PX: Final = 0.1  # of a flow, because patches err by some hundredths, and people and shadows are near by
MOST_SCALE: Final = 25.0  # of the variance of flows: half a pixel; where it is larger, flows are displaced
LINES: Final = 24  # equal parts of the raw image, at whose borders lines are tried
LEAST: Final = 8  # flows on either side of a line in the cameras of a break
# Part that counts: of the flows, that no break displaces; of those of a torn image, on either side of its line, as
# people hardly cover as many; of all that right images leave.
LEAST_PART: Final = 0.2
RIGHT_COST: Final = float(cost(VIEW))  # of a landmark (`PoseEstimate.cost`) whose view has the noise that is expected
FOLLOWED: Final = 0.2  # part of a new pair in the mean of the costs
TORN, DISPLACED = 6, 3  # unknowns of another motion, and of a shift and a turn of the raw image


class Break(NamedTuple):
    """A break of the images of one camera, or of both, at a pair."""

    is_torn: bool  # otherwise it is displaced
    cameras: tuple[int, ...]  # 0: lower, 1: upper
    is_before: bool  # what is before the line is displaced, and not what is beyond
    line: float  # part of the raw image that is before the line; 0: the whole image is displaced
    amount: Array  # (C, 3) raw px, raw px, turn [rad]; of torn images (1, 6): motion
    gain: float  # logarithm of the likelihood ratio, less the cost of the parameters
    px: float  # by which what is beyond is displaced in view, mean

    def is_undone_by(self, other: Break) -> bool:
        """True if another displacement ends this one."""
        if not set(self.cameras) & set(other.cameras):
            return False
        mine, others = (found.amount[:, :2].mean(axis=0) for found in (self, other))
        return float(np.linalg.norm(mine + others)) < 0.5 * max(map(float, map(np.linalg.norm, (mine, others))))

    def words(self, raws: tuple[RawImage, RawImage]) -> str:
        """Return what it was, and what to do."""
        line, cameras = round(self.line * raws[self.cameras[0]].size[1]), camera_names(self.cameras)
        if self.is_torn:
            return (
                f"images of the {cameras} are torn at row {line}: what is below is of another moment than what is "
                "above; check bandwidth and buffers, poses were degraded"
            )
        u, v, turn_rad = self.amount.mean(axis=0)
        part = f" {'above' if self.is_before else 'below'} row {line}" if line else ""
        if not line and len(self.cameras) == 1:
            part = f" against those of the {CAMERAS[1 - self.cameras[0]]} one"
        return (
            f"images of the {cameras} were displaced by {u:+.1f}, {v:+.1f} px{part}, and turned by "
            f"{math.degrees(turn_rad):+.2f} deg: the rig does not fit them; check the mirror, the sensor's window and "
            "the driver, poses were degraded"
        )


class _View(NamedTuple):
    """A pair with its pose."""

    pair: tuple[PaddedPanorama, PaddedPanorama]
    T_odom_rect: Array
    exposure: Exposure
    step: Array  # (6,) that led to it


class ImageBreaks:
    """Follows the breaks of a run from pair to pair."""

    def __init__(self, model: StereoModel, raws: tuple[RawImage, RawImage]) -> None:
        self.lines = LineTimes(model, raws)  # of the same images
        self.covariance = np.zeros((6, 6))  # [t; r] that breaks add to that of the pose
        self.fault = ""  # how the images of the last pair are broken, in words; empty: they are whole
        self.words: dict[tuple[str | bool, tuple[int, ...]], str] = {}  # by kind and cameras
        self._model, self._raws = model, raws
        self._torn = 0.0  # gains of tears, less those forgotten
        self._last: _View | None = None
        self._last_tear: Break | None = None
        self._open: Break | None = None  # a displacement that has not ended
        self._usual_cost = 0.0  # of a landmark in whole images: none is known yet, so that the first pairs are tested

    def add(
        self,
        pair: tuple[PaddedPanorama, PaddedPanorama],
        estimate: OdometryEstimate,
        local_map: LocalMap,
        dt_s: float,
        costs: tuple[float, int] | None,
    ) -> None:
        """Use a pair with its pose, dt_s after the one before.

        costs: mean of the landmarks in view, and their number, None: no pose was found. A break costs at least as much
        as it must explain to be believed: where the views fit as usual there is none, and no flow is measured.
        """
        last, found, exposure = self._last, None, estimate.exposure
        assert exposure is not None
        step = np.zeros(6) if last is None else se3.log(se3.inverse(last.T_odom_rect) @ estimate.T_odom_rect)
        self._last = now = _View(pair, estimate.T_odom_rect, exposure, step)
        is_broken = self._torn > DECIDING_COST or self._open is not None
        is_usual = costs is not None and costs[1] * (costs[0] - self._usual_cost) < DECIDING_COST and not is_broken
        # A pose that was only predicted says too little about the motion between several exposures.
        is_known = exposure.times.is_synchronised or (costs is not None and exposure.is_known)
        if last is not None and dt_s > 0 and is_known and last.exposure.is_known and not is_usual:
            flow = _flow((last, now), self._raws, local_map, self._model, LAG_S / dt_s)
            found = None if flow is None else likeliest_break(flow)
        if costs is not None and found is None:
            usual = self._usual_cost + FOLLOWED * (costs[0] - self._usual_cost)
            self._usual_cost = min(usual, RIGHT_COST)  # a run whose images are broken from the start is not usual
        # What it makes uncertain. A torn image shows the rig up to an image too early, and landmarks are misplaced by
        # as much. A displaced one turns directions, and moves the rig by as much of the landmarks' range. Lines that
        # are read one after another show it within the time that they take: what that is likelier than none adds, and
        # above the odds of a break it is reported.
        self._torn *= math.exp(-dt_s / MEMORY_S)
        if found is not None and found.is_torn:
            self._torn, self._last_tear = self._torn + found.gain, found
        elif found is not None:
            self._open = None if self._open is not None and self._open.is_undone_by(found) else found
        is_torn = self._torn > DECIDING_COST
        shown = found or (self._last_tear if is_torn else None) or self._open
        read_out = self.lines.likeliest() if shown is None else None
        self.fault = "" if shown is None else shown.words(self._raws)
        if shown is not None:
            self.words.setdefault((shown.is_torn, shown.cameras), self.fault)
        elif read_out is not None and read_out.gain > DECIDING_COST:
            self.fault = self.words["rows", read_out.cameras] = read_out.words(self._raws)
        if last is None or (shown is None and read_out is None and not self.covariance.any()):
            return
        A = se3.adjoint(se3.exp(-step))
        share = 1.0 if is_torn else min(1.0, abs(read_out.time_s) / dt_s) if read_out is not None and dt_s else 0.0
        angle_rad = 0.0 if found is None else found.px / self._model.cylinder.focal_px
        self.covariance = A @ self.covariance @ A.T
        self.covariance += share**2 * (np.outer(step, step) + np.outer(last.step, last.step))
        self.covariance += angle_rad**2 * np.diag(np.repeat([estimate.distance_m**2, 1.0], 3))


@dataclass(frozen=True, slots=True)
class _Flow:
    """Flows of landmarks that are not explained by the step, in standard deviations, and what right images leave."""

    y: Array  # (N, 2)
    null: Array  # (N, 2, 6 + K) derivatives by the step's error, and by K errors of unit variance: lag and velocities
    shift: Array  # (N, 2, 3) by a shift and a turn of the raw image
    camera: Indices  # (N,)
    row: Array  # (N,) of the raw image, as a fraction of it
    px: Array  # (N,) standard deviations

    def whole(self) -> tuple[Array, float, float]:
        """Return what right images leave, robustly, from no error of the step and from that of all flows.

        (N, 2); the squared distance from which on flows cost no more; and that which counts as 1 in a logarithm of
        likelihoods.
        """
        size = self.null.shape[2]
        starts = np.zeros(size), _least_squares(self.null, self.y, np.ones(len(self.y)), size)
        lefts = [self.y - self.null @ _robust(self.null, self.y, start, size) for start in starts]
        squares = [(left**2).sum(axis=1) for left in lefts]
        # A step that is wrong must explain much more to be believed.
        costs = [np.minimum(each, 2 * OUTLIER_SQUARED * MOST_SCALE).sum() for each in squares]
        best = int(costs[1] < costs[0] / 2)
        # So many sums of two squares of unit variance are below -2 log(1 - LEAST_PART).
        scale = np.quantile(squares[best], LEAST_PART) / (-2 * math.log(1 - LEAST_PART))
        scale = float(np.clip(scale, 1.0, MOST_SCALE))
        return lefts[best], 2 * OUTLIER_SQUARED * scale, 2 * scale * CORRELATED


def _flow(
    views: tuple[_View, _View], raws: tuple[RawImage, RawImage], local_map: LocalMap, model: StereoModel, lag: float
) -> _Flow | None:
    """Return the flows of the landmarks that the map shows in the first of two pairs; None: too few are found.

    lag: standard deviation as a fraction of a step.
    """
    (last, now), cylinder, baseline_m = views, model.cylinder, model.baseline_m
    landmarks, _ = local_map.visible(last.T_odom_rect)
    landmarks = landmarks[:: max(1, -(-len(landmarks) // MOST))]
    points, covariance = local_map.table.points[landmarks], local_map.table.covariance[landmarks]
    slopes = local_map.slopes(last.T_odom_rect, landmarks)
    seen = [se3.apply(se3.inverse(each.T_odom_rect), points) for each in views]
    shifts = [each.exposure.shift(at) for each, at in zip(views, seen, strict=True)]
    pixels = [view(at, cylinder, baseline_m) for at in seen]
    before, after = (motion_jacobian(at, cylinder, baseline_m) for at in seen)
    of_point = after[:, :, :3] @ now.T_odom_rect[:3, :3].T - before[:, :, :3] @ last.T_odom_rect[:3, :3].T
    parts, sought = [], 0
    for camera, raw_image in enumerate(raws):
        # 1. Landmarks that both pairs show, tracked from where the step predicts them, else as if the rig had stood, as
        #    torn images show them. Their patches are aligned, bent as the step bends them.
        own, of_shift = ([0, 1], [0, 1]) if camera == 0 else ([0, 2], [3, 2])
        start, end = (at[:, own] - shift.px[:, of_shift] for at, shift in zip(pixels, shifts, strict=True))
        raw, by_raw = raw_image.at(end), raw_image.derivatives(end)
        inside = np.isfinite(raw).all(axis=1) & np.isfinite(by_raw).all(axis=(1, 2))
        for at in (start, end):
            inside &= np.abs(at[:, 1] - cylinder.height / 2) < (cylinder.height - WINDOW_PX - 2) / 2
            inside &= cylinder.shows(at[:, 0])
        rows = np.flatnonzero(inside)
        sought += len(rows)
        there, found = end.copy(), np.zeros(len(end), bool)
        for guess in (end, start):
            rest = rows[~found[rows]]
            tracked, ok = track(last.pair[camera], now.pair[camera], start[rest], guess[rest], KltSettings())
            there[rest[ok]], found[rest[ok]] = tracked[ok], True
        # The upper camera is like a lower one whose frame is higher, in which slopes are those over its own rows.
        up, bent = np.eye(4), slopes[rows] / (1.0 + camera * slopes[rows, 1:])
        up[2, 3] = -camera * baseline_m
        T_now_last = up @ se3.inverse(now.T_odom_rect) @ last.T_odom_rect @ se3.inverse(up)
        planes = (se3.apply(up, seen[0][rows]), bent), T_now_last, there[rows]
        templates = plane_templates(last.pair[camera], start[rows], *planes, model)
        aligned = align(templates, now.pair[camera], there[rows])
        is_aligned = rows[aligned.found]
        there[is_aligned], found[is_aligned] = aligned.pixels[aligned.found], True
        rows = np.flatnonzero(found)
        d = there[rows] - end[rows]
        d[:, 0] = cylinder.wrap(d[:, 0])
        # 2. Derivatives, in standard deviations.
        noise = np.einsum("nij,njk,nik->ni", of_point[rows][:, own], covariance[rows], of_point[rows][:, own])
        px = np.sqrt(SIGMA_PX**2 + noise.mean(axis=1))
        J, of_raw = -after[rows][:, own] / px[:, None, None], by_raw[rows] / px[:, None, None]
        size = np.array(raw_image.size)
        arm = raw[rows] - (size - 1) / 2
        turn = of_raw @ np.column_stack([-arm[:, 1], arm[:, 0]])[:, :, None]
        common = [lag * camera * (J @ now.step)[:, :, None]]
        for shift in shifts:
            by_motion = shift.by_motion[rows][:, of_shift] / px[:, None, None]
            common.append(by_motion @ np.linalg.cholesky(shift.motion.covariance))
        null = np.concatenate([J, *common], axis=2)
        of_raw, of_camera = np.concatenate([of_raw, turn], axis=2), np.full(len(rows), camera)
        parts.append((d / px[:, None], null, of_raw, of_camera, raw[rows, 1] / size[1], px))
    flow = _Flow(*(np.concatenate(part) for part in zip(*parts, strict=True)))
    return flow if len(flow.y) >= max(3 * LEAST, sought / 2) else None


def likeliest_break(flow: _Flow) -> Break | None:
    """Return the likeliest break that flows show beyond doubt; None: there is none."""
    left, outlier, unit = whole = flow.whole()
    all_gain = float(np.minimum((left**2).sum(axis=1), outlier).sum()) / unit
    if all_gain < DECIDING_COST + _cost(DISPLACED, len(flow.y)):
        return None  # no break explains more than all that is left
    found: list[Break] = []
    for size in (TORN, DISPLACED):
        # The six unknowns of a motion fit some of many wrong depths.
        least = max(DECIDING_COST, LEAST_PART * all_gain * (size == TORN))
        each = (broken for cameras in SETS for broken in _candidates(flow, whole, size, cameras))
        found += [broken for broken in each if broken.gain > least]
    best = max(found, key=lambda broken: broken.gain, default=None)
    # What is too small harms no pose.
    return best if best is not None and best.px >= LEAST_PX else None


def _candidates(flow: _Flow, whole: tuple[Array, float, float], size: int, cameras: tuple[int, ...]) -> Iterator[Break]:
    """Yield the likeliest breaks of a kind (its unknowns) in some cameras; whole: see _Flow."""
    (whole_left, outlier, unit), y, null, unknowns = whole, flow.y, flow.null, flow.null.shape[2]
    whole_squared, is_torn = (whole_left**2).sum(axis=1), size == TORN

    def gains(left: Array) -> Array:
        squared = (left**2).sum(axis=1)
        return np.asarray((np.minimum(whole_squared, outlier) - np.minimum(squared, outlier)) / unit)

    is_off = whole_squared >= outlier
    most_off = int(np.bincount(flow.camera[is_off], minlength=2).argmax())
    own = [flow.camera == camera for camera in cameras]
    # 1. A motion is one of both cameras, a displacement is one of each.
    F, masks = (null[:, :, :size], [np.logical_or.reduce(own)]) if is_torn else (flow.shift, own)
    columns = np.concatenate([F * mask[:, None, None] for mask in masks], axis=2)
    # 2. Amounts to start from: of all flows, and of those that right images do not explain.
    starts = []
    if not is_torn:
        tried = np.concatenate([null, columns], axis=2)
        starts.append(_robust(tried, y, _least_squares(tried, y, np.ones(len(y)), unknowns), unknowns))
    parts = [np.flatnonzero(mask & is_off) for mask in masks]
    if min(map(len, parts)) >= LEAST:
        amounts = np.concatenate([_common(F[rows], whole_left[rows]) for rows in parts])
        starts.append(np.concatenate([np.zeros(unknowns), amounts]))
        if is_torn:  # the pose may have followed the part that is torn
            starts.append(np.concatenate([amounts, np.zeros(unknowns - TORN), -amounts]))
    for start in starts:
        # 3. The likeliest line, of both sides; 0: the whole image.
        left = y - null @ start[:unknowns]
        extra = gains(left - columns @ start[unknowns:]) - gains(left)
        for side, line in _likely_lines(flow.row, extra, own, is_torn=is_torn):
            # One image displaced is the other one displaced the other way, and a step.
            if line == 0 and cameras == (1 - most_off,):
                continue
            # 4. The amount and the step together, and the likelihood.
            beyond = (flow.row >= line) != side
            masked = np.concatenate([null, columns * beyond[:, None, None]], axis=2)
            solution = _robust(masked, y, start, unknowns)
            gain = float(gains(y - masked @ solution).sum()) - _cost(columns.shape[2], len(y))
            moved_px = np.linalg.norm(masked[:, :, unknowns:] @ solution[unknowns:], axis=1) * flow.px
            px = float(moved_px.sum() / max(1, np.count_nonzero(moved_px)))
            yield Break(is_torn, cameras, side, line, solution[unknowns:].reshape(len(masks), -1), gain, px)


def _likely_lines(row: Array, extra: Array, own: list[Flags], *, is_torn: bool) -> list[tuple[bool, float]]:
    """Return side and line, a part of the raw image, of the whole image (if it is not torn) and of the likeliest line.

    row, extra (N,): of each flow, its row and by how much likelier a break makes it; own: flags (N,) of each camera
    that may have the break.
    """
    found, lines = [] if is_torn else [(False, 0.0)], np.arange(1, LINES) / LINES
    is_beyond = row >= lines[:, None]
    enough = np.ones(len(lines), bool)
    for each in own:
        least = LEAST_PART * each.sum() if is_torn else LEAST / len(own)
        enough &= ((is_beyond & each).sum(axis=1) >= least) & ((~is_beyond & each).sum(axis=1) >= least)
    gains = np.where(enough, np.stack([is_beyond @ extra, ~is_beyond @ extra]), -np.inf)
    side, number = np.unravel_index(gains.argmax(), gains.shape)
    return [*found, (bool(side), float(lines[number]))] if gains.max() > 0 else found


def _cost(parameters: int, flows: int) -> float:
    """Return the penalty of a break with so many parameters by so many flows, and of the choice.

    Chosen are side and line, one of two kinds, and cameras.
    """
    return 0.5 * parameters * math.log(2 * flows) + math.log(2 * LINES * 2 * len(SETS))


def _common(A: Array, y: Array) -> Array:
    """Return x (K,) that most of y - A x (N, 2) agree with."""
    return _robust(A, y, np.median((np.linalg.pinv(A) @ y[:, :, None])[:, :, 0], axis=0))


def _robust(A: Array, y: Array, x: Array, known: int = 0) -> Array:
    """Return x (K,) that minimises the Geman-McClure cost of y - A x, A (N, 2, K), from a start."""
    for _ in range(GAUSS_NEWTON_STEPS):
        x = _least_squares(A, y, 1.0 / (1.0 + ((y - A @ x) ** 2).sum(axis=1) / 4.0) ** 2, known)
    return x


def _least_squares(A: Array, y: Array, weight: Array, known: int = 0) -> Array:
    """Return x (K,) that minimises the sum of weights (N,) times |y - A x|^2; x[6:known] has unit variance."""
    size = A.shape[2]
    weighted, prior = (weight[:, None, None] * A).reshape(-1, size), np.full(size, DAMPING)
    prior[TORN:known] = 1.0
    return np.asarray(np.linalg.solve(weighted.T @ A.reshape(-1, size) + np.diag(prior), weighted.T @ y.ravel()))
