"""Images that are whole, but not of one instant or of one geometry: torn, displaced, with lines missing or twice.

Landmarks flow from one pair to the next as the step of the rig says, and what is left of their flow is noise, if the
images are right. With the flow d_i of landmark i in the panorama of a camera, less the flow that the step predicts,

    H0:  d_i = J_i x + noise                                     x (6,): error of the step
    H1:  d_i = J_i x + [i lies beyond the line] F_i a + noise    in one camera, or in both

F_i a is a shift in the raw image (its window moved, lines repeat or are missing), a shift and a turn of the whole image
(a mirror moved), or another motion of the rig (what is beyond the line is of another image, as in torn ones, or the
rows are exposed one after the other). Lines are rows of the raw image. What moves in view, as people do, does not end
at a raw line. H1 is compared with H0 by the generalised likelihood
ratio, robustly, with the Bayesian information criterion (Schwarz 1978).

The flow shows a displacement in the pair in which it begins, and once more where it ends: in between, the landmarks
that were seen since agree with it. So it stays until its opposite is seen. A torn image shows it whenever the rig
changes its motion; the evidence is summed up, and forgotten within seconds.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Final, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from calib import se3
from omnid.core.odometry.estimates import OdometryEstimate
from omnid.core.odometry.exposure_times import Exposure
from omnid.core.odometry.line_times import (
    CAMERAS,
    LAG_S,
    LEAST_PX,
    MEMORY_S,
    SETS,
    LineTimes,
    RawImage,
    ReadOut,
    camera_names,
)
from omnid.core.odometry.local_map import LocalMap
from omnid.core.odometry.motion_hypotheses import DECIDING_COST
from omnid.core.odometry.plane_patches import WINDOW_PX, align, plane_templates
from omnid.core.odometry.pose_estimation import CORRELATED
from omnid.core.odometry.tracking import KltSettings, track
from omnid.core.stereo.triangulation import view, view_jacobian
from omnid.core.types.panorama import PaddedPanorama
from omnid.core.types.stereo_model import StereoModel

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]
Indices = NDArray[np.intp]
Pair = tuple[PaddedPanorama, PaddedPanorama]
Kind = Literal["torn", "displaced", "turned"]

MOST: Final = 160  # landmarks that are followed in each camera
SIGMA_PX: Final = 0.1  # of a flow, because patches err by some hundredths, and people and shadows are near by
# Squared Mahalanobis distance of a flow, a sum of two squares, from which on it is an outlier, and costs no more.
OUTLIER_SQUARED: Final = 32.0
MOST_SCALE: Final = 25.0  # of the variance of flows: half a pixel; where it is larger, flows are displaced
GOOD_SHARE: Final = 0.2  # of the flows, that no break displaces: of one camera, or up to a line
LINES: Final = 24  # equal parts of the raw image, at whose borders lines are tried
LEAST: Final = 8  # flows on either side of a line in the cameras of a break
# Part that counts: of the flows of a torn image, on either side of its line, as people hardly cover as many; of all
# that right images leave; of the displacement of the other camera.
LEAST_PART: Final = 0.2
# Cost of a landmark (`PoseEstimate.cost`) whose view has the noise that is expected: the mean of the Cauchy kernel's.
RIGHT_COST: Final = 0.31
FOLLOWED: Final = 0.2  # part of a new pair in the mean of the costs
FAR: Final = KltSettings(levels=2)  # 28 px
ROUNDS: Final = 6
RIDGE: Final = 1e-6
KINDS: Final[tuple[tuple[Kind, tuple[int, ...]], ...]] = (
    *(("torn", cameras) for cameras in SETS),
    *(("displaced", cameras) for cameras in SETS),
    *(("turned", cameras) for cameras in SETS[:2]),  # both images turned by the same angle are a turn of the rig
)
CHOICES: Final = 2 * LINES * len(KINDS)  # sides, lines, kinds


class Break(NamedTuple):
    """A break of the images of one camera, or of both, at a pair."""

    kind: Kind
    cameras: tuple[int, ...]  # 0: lower, 1: upper
    line_px: int  # row of the raw image; 0: the whole image
    is_before: bool = False  # what is before the line is displaced, and not what is beyond
    amount: Array = np.zeros((1, 2))  # (C, K) raw px, and turn, rad; of torn images none
    angle_rad: float = 0.0  # by which what is beyond is displaced in view, mean
    gain: float = 0.0  # logarithm of the likelihood ratio, less the cost of the parameters

    def is_undone_by(self, other: Break) -> bool:
        """True if another displacement ends this one."""
        if not set(self.cameras) & set(other.cameras):
            return False
        mine, others = (found.amount[:, :2].mean(axis=0) for found in (self, other))
        return float(np.linalg.norm(mine + others)) < 0.5 * max(map(float, map(np.linalg.norm, (mine, others))))


class _View(NamedTuple):
    """A pair with its pose."""

    pair: Pair
    T_odom_rect: Array
    exposure: Exposure
    step: Array  # (6,) that led to it


class _Flow(NamedTuple):
    """Flows of landmarks that are not explained by the step, in standard deviations; rows of all cameras."""

    y: Array  # (N, 2)
    null: Array  # (N, 2, 7) derivatives by the step's error, and by the lag of the upper camera
    shift: Array  # (N, 2, 3) by a shift and a turn of the raw image
    camera: Indices  # (N,)
    row: Array  # (N,) of the raw image, as a fraction of it
    px: Array  # (N,) standard deviations


class _Whole(NamedTuple):
    """What right images leave of the flows."""

    left: Array  # (N, 2)
    squared: Array  # (N,)
    outlier: float  # squared distance from which on flows cost no more
    unit: float  # squared distance that counts as 1 in a logarithm of likelihoods

    def gains(self, left: Array) -> Array:
        """Return by how much likelier flows (N,) are that leave (N, 2)."""
        squared = (left**2).sum(axis=1)
        return np.asarray((np.minimum(self.squared, self.outlier) - np.minimum(squared, self.outlier)) / self.unit)


@dataclass(slots=True)
class ImageBreaks:
    """Follows the breaks of a run from pair to pair."""

    model: StereoModel
    raws: tuple[RawImage, RawImage]
    lines: LineTimes  # of the same images
    covariance: Array = field(default_factory=lambda: np.zeros((6, 6)))  # [t; r] that breaks add to that of the pose
    fault: str = ""  # how the images of the last pair are broken, in words; empty: they are whole
    _torn: float = 0.0  # gains of tears, less those forgotten
    _last: _View | None = None
    _last_tear: Break | None = None
    _open: list[Break] = field(default_factory=list)  # displacements that have not ended
    _usual_cost: float = 0.0  # of a landmark in whole images: none is known yet, so that the first pairs are tested
    # The first break of each kind and cameras, and the number of pairs that showed one.
    _found: dict[tuple[Kind, tuple[int, ...]], tuple[Break, int]] = field(default_factory=dict)
    _read_out: dict[tuple[int, ...], ReadOut] = field(default_factory=dict)  # likeliest by cameras

    def add(
        self,
        pair: Pair,
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
        last, found = self._last, None
        step = np.zeros(6) if last is None else se3.log(se3.inverse(last.T_odom_rect) @ estimate.T_odom_rect)
        now = _View(pair, estimate.T_odom_rect, exposure, step)
        is_usual = cost is not None and cost[1] * (cost[0] - self._usual_cost) < DECIDING_COST and not self._is_broken
        # A pose that was only predicted says too little about the motion between several exposures.
        is_known = exposure.times.is_at_once or (cost is not None and exposure.is_known)
        if last is not None and dt_s > 0 and is_known and last.exposure.is_known and not is_usual:
            flow = self._flow(last, now, local_map, LAG_S / dt_s)
            found = None if flow is None else likeliest_break(flow, self.raws, self.model.cylinder.focal_px)
        if cost is not None and found is None:
            usual = self._usual_cost + FOLLOWED * (cost[0] - self._usual_cost)
            self._usual_cost = min(usual, RIGHT_COST)  # a run whose images are broken from the start is not usual
        self._spread(last, step, found, dt_s, estimate.distance_m)
        self._last = now

    @property
    def words(self) -> list[str]:
        """One line for each kind of break and the cameras that showed it."""
        read_out = [found.words(self.raws) for found in self._read_out.values()]
        return [_words(first, pairs) for first, pairs in self._found.values()] + read_out

    @property
    def _is_broken(self) -> bool:
        """True while a tear has been seen lately, or a displacement has not ended."""
        return self._torn > DECIDING_COST or bool(self._open)

    def _spread(self, last: _View | None, step: Array, found: Break | None, dt_s: float, range_m: float) -> None:
        """Add what a break makes uncertain; range_m: that of the landmarks.

        A torn image shows the rig up to an image too early, and landmarks are misplaced by as much. A displaced one
        turns directions, and moves the rig by as much of the landmarks' range. Lines that are read one after another
        show it within the time that they take: what that is likelier than none adds, and above the odds of a break it
        is told.
        """
        self._torn *= math.exp(-dt_s / MEMORY_S)
        if found is not None:
            first, pairs = self._found.get((found.kind, found.cameras), (found, 0))
            self._found[found.kind, found.cameras] = first, pairs + 1
            if found.kind == "torn":
                self._torn, self._last_tear = self._torn + found.gain, found
            else:
                before = self._open
                self._open = [earlier for earlier in before if not earlier.is_undone_by(found)]
                self._open += [found] if len(self._open) == len(before) else []
        is_torn = self._torn > DECIDING_COST
        shown = found or (self._last_tear if is_torn else None) or (self._open[-1] if self._open else None)
        read_out = self.lines.likeliest() if shown is None else None
        is_read = read_out is not None and read_out.gain > DECIDING_COST
        self.fault = "" if shown is None else _words(shown)
        if read_out is not None and is_read:
            before_it = self._read_out.get(read_out.cameras, read_out)
            self._read_out[read_out.cameras] = max(read_out, before_it, key=lambda each: each.gain)
            self.fault = read_out.words(self.raws)
        if last is None or (shown is None and read_out is None and not self.covariance.any()):
            return
        A = se3.adjoint(se3.exp(-step))
        self.covariance = A @ self.covariance @ A.T
        share = 1.0 if is_torn else min(1.0, abs(read_out.time_s) / dt_s) if read_out is not None and dt_s else 0.0
        self.covariance = self.covariance + share**2 * (np.outer(step, step) + np.outer(last.step, last.step))
        if found is not None:
            self.covariance = self.covariance + found.angle_rad**2 * np.diag(np.repeat([range_m**2, 1.0], 3))

    def _flow(self, last: _View, now: _View, local_map: LocalMap, lag: float) -> _Flow | None:
        """Return the flows of the landmarks that the map shows in the last pair, None: too few of them are found.

        lag: standard deviation as a fraction of a step.
        """
        cylinder, baseline_m = self.model.cylinder, self.model.baseline_m
        landmarks, _ = local_map.visible(last.T_odom_rect)
        landmarks = landmarks[:: max(1, -(-len(landmarks) // MOST))]
        covariance, slopes = local_map.table.covariance[landmarks], local_map.slopes(last.T_odom_rect, landmarks)
        before, after = (
            se3.apply(se3.inverse(each.T_odom_rect), local_map.table.points[landmarks]) for each in (last, now)
        )
        shifts = last.exposure.shift(before), now.exposure.shift(after)
        views = tuple(view(points, cylinder, baseline_m) for points in (before, after))
        J_before, J_now = (view_jacobian(points, cylinder, baseline_m) for points in (before, after))
        of_step = np.concatenate([np.broadcast_to(-np.eye(3), (len(after), 3, 3)), se3.hat(after)], axis=2)
        of_point = J_now @ now.T_odom_rect[:3, :3].T - J_before @ last.T_odom_rect[:3, :3].T
        parts, sought = [], 0
        for camera, raw_image in enumerate(self.raws):
            # 1. Landmarks that both pairs show, and where they are instead of where the step puts them.
            own = [0, 1 + camera]
            started, ended = ((each.lower, each.upper)[camera] for each in shifts)
            start, end = views[0][:, own] - started, views[1][:, own] - ended
            raw, by_raw = raw_image.at(end)
            inside = np.isfinite(raw).all(axis=1)
            for pixels in (start, end):
                inside &= np.abs(pixels[:, 1] - cylinder.height / 2) < (cylinder.height - WINDOW_PX - 2) / 2
                inside &= cylinder.shows(pixels[:, 0])
            rows = np.flatnonzero(inside)
            sought += len(rows)
            surfaces = before[rows], slopes[rows]
            there, found = self._found_at(camera, (last, now), surfaces, (start[rows], end[rows]))
            rows, d = rows[found], there[found] - end[rows[found]]
            d[:, 0] = cylinder.wrap(d[:, 0])
            # 2. Derivatives, in standard deviations.
            noise = np.einsum("nij,njk,nik->ni", of_point[rows][:, own], covariance[rows], of_point[rows][:, own])
            of_motion = [0, 1] if camera == 0 else [3, 2]
            noise += shifts[1].variance(now.exposure.motion)[rows][:, of_motion]
            px = np.sqrt(SIGMA_PX**2 + noise.mean(axis=1))
            J, shift = J_now[rows][:, own] @ of_step[rows] / px[:, None, None], by_raw[rows] / px[:, None, None]
            size = np.array(raw_image.size)
            arm = raw[rows] - (size - 1) / 2
            turn = shift @ np.column_stack([-arm[:, 1], arm[:, 0]])[:, :, None]
            null = np.concatenate([J, lag * camera * (J @ now.step)[:, :, None]], axis=2)
            shift, of_camera = np.concatenate([shift, turn], axis=2), np.full(len(rows), camera)
            parts.append(_Flow(d / px[:, None], null, shift, of_camera, raw[rows, 1] / size[1], px))
        flow = _Flow(*(np.concatenate(part) for part in zip(*parts, strict=True)))
        return flow if len(flow.y) >= max(3 * LEAST, sought / 2) else None

    def _found_at(
        self,
        camera: int,
        between: tuple[_View, _View],
        surfaces: tuple[Array, Array],
        seen: tuple[Array, Array],
    ) -> tuple[Array, Flags]:
        """Return the pixels (M, 2) of landmarks in a camera's newer panorama, and flags (M,): they were found.

        surfaces: points (M, 3) [m] and slopes (M, 2) in the older rectified frame; seen (M, 2), (M, 2): pixels there,
        and as the step predicts. They are tracked from there, else as if the rig had stood, as torn images show it.
        Then their patches are aligned, bent as the step bends them; those that were not tracked where the step
        predicts them.
        """
        (start, end), (last, now), (before, slopes) = seen, between, surfaces
        there, found = end.copy(), np.zeros(len(start), bool)
        for guess in (end, start):
            rest = np.flatnonzero(~found)
            tracked, found[rest] = track(last.pair[camera], now.pair[camera], start[rest], guess[rest], FAR)
            there[rest] = np.where(found[rest][:, None], tracked, there[rest])
        # The upper camera is like a lower one whose frame is higher, in which slopes are those over its own rows.
        up = np.eye(4)
        if camera:
            up[2, 3] = -self.model.baseline_m
            slopes = slopes / (1.0 + slopes[:, 1:])
        T_now_last = np.tile(up @ se3.inverse(now.T_odom_rect) @ last.T_odom_rect @ se3.inverse(up), (len(start), 1, 1))
        one, surfaces = np.zeros(len(start), np.intp), (se3.apply(up, before), slopes)
        templates = plane_templates({0: last.pair[camera]}, one, start, surfaces, T_now_last, self.model, there)
        aligned = align(templates, now.pair[camera], there)
        return np.where(aligned.found[:, None], aligned.pixels, there), aligned.found | found


def _whole(flow: _Flow) -> _Whole:
    """Return what right images leave of flows, robustly, from no error of the step and from that of all flows."""
    y, null = flow.y, flow.null
    starts = (np.zeros(null.shape[2]), _least_squares(null, y, np.ones(len(y))))
    lefts = [y - null @ _robust(null, y, start) for start in starts]
    squares = [(left**2).sum(axis=1) for left in lefts]
    # A step that is wrong must explain much more to be believed.
    costs = [np.minimum(each, OUTLIER_SQUARED * MOST_SCALE).sum() for each in squares]
    best = int(costs[1] < costs[0] / 2)
    # So many sums of two squares of unit variance are below -2 log(1 - GOOD_SHARE).
    scale = np.quantile(squares[best], GOOD_SHARE) / (-2 * math.log(1 - GOOD_SHARE))
    scale = float(np.clip(scale, 1.0, MOST_SCALE))
    return _Whole(lefts[best], squares[best], OUTLIER_SQUARED * scale, 2 * scale * CORRELATED)


def likeliest_break(flow: _Flow, raws: tuple[RawImage, RawImage], focal_px: float) -> Break | None:
    """Return the likeliest break that flows show beyond doubt; None: there is none."""
    whole = _whole(flow)
    all_gain = float(np.minimum(whole.squared, whole.outlier).sum()) / whole.unit
    if all_gain < DECIDING_COST + _cost(2, len(flow.y)):
        return None  # no break explains more than all that is left
    found = (
        each
        for kind, cameras in KINDS
        for each in _candidates(flow, whole, kind, cameras)
        if kind != "torn" or each.gain > LEAST_PART * all_gain  # six unknowns fit some of many wrong depths
    )
    best = max(found, key=lambda each: each.gain, default=None)
    if best is None or best.gain < DECIDING_COST:
        return None
    # Cameras that have a share in it; what is too small harms no pose.
    moved_px = np.linalg.norm(best.displaced, axis=1) * flow.px
    mean_px = [float(moved_px[(flow.camera == camera) & (moved_px > 0)].mean()) for camera in best.cameras]
    shares = [number for number, px in enumerate(mean_px) if px > LEAST_PART * max(mean_px)]
    if max(mean_px) < LEAST_PX:
        return None
    cameras = tuple(best.cameras[number] for number in shares)
    amount = np.zeros((1, 2)) if best.kind == "torn" else best.amount.reshape(len(best.cameras), -1)[shares]
    line_px, angle_rad = round(best.line * raws[cameras[0]].size[1]), max(mean_px) / focal_px
    return Break(best.kind, cameras, line_px, best.is_before, amount, angle_rad, best.gain)


class _Candidate(NamedTuple):
    kind: Kind
    cameras: tuple[int, ...]
    is_before: bool  # what is before the line is displaced
    line: float  # part of the raw image that is before the line; 0: the whole image is displaced
    amount: Array  # (K,)
    displaced: Array  # (N, 2) by it, in standard deviations
    gain: float


def _candidates(flow: _Flow, whole: _Whole, kind: Kind, cameras: tuple[int, ...]) -> Iterator[_Candidate]:
    """Yield the likeliest breaks of a kind in some cameras."""
    y, null, unknowns = flow.y, flow.null, flow.null.shape[2]
    is_off = whole.squared >= whole.outlier
    most_off = int(np.bincount(flow.camera[is_off], minlength=2).argmax())
    own = [flow.camera == camera for camera in cameras]
    # 1. A motion is one of both cameras, a displacement is one of each.
    F = null[:, :, :6] if kind == "torn" else flow.shift[:, :, : 3 if kind == "turned" else 2]
    masks = [np.logical_or.reduce(own)] if kind == "torn" else own
    columns = np.concatenate([F * mask[:, None, None] for mask in masks], axis=2)
    # 2. Amounts to start from: of all flows, and of those that right images do not explain.
    starts = []
    if kind != "torn":
        tried = np.concatenate([null, columns], axis=2)
        starts.append(_robust(tried, y, _least_squares(tried, y, np.ones(len(y)))))
    parts = [np.flatnonzero(mask & is_off) for mask in masks]
    if min(map(len, parts)) >= LEAST:
        amounts = np.concatenate([_common(F[rows], whole.left[rows]) for rows in parts])
        starts.append(np.concatenate([np.zeros(unknowns), amounts]))
        if kind == "torn":  # the pose may have followed the part that is torn
            starts.append(np.concatenate([amounts, [0.0], -amounts]))
    for start in starts:
        # 3. The likeliest line, of both sides; 0: the whole image.
        left = y - null @ start[:unknowns]
        extra = whole.gains(left - columns @ start[unknowns:]) - whole.gains(left)
        for side, line in _likely_lines(flow, kind, extra, own):
            # One image displaced is the other one displaced the other way, and a step.
            if line == 0 and cameras == (1 - most_off,):
                continue
            # 4. The amount and the step together, and the likelihood.
            beyond = (flow.row >= line) != side
            masked = np.concatenate([null, columns * beyond[:, None, None]], axis=2)
            solution = _robust(masked, y, start)
            gain = float(whole.gains(y - masked @ solution).sum()) - _cost(columns.shape[2], len(y))
            amount = solution[unknowns:]
            yield _Candidate(kind, cameras, side, line, amount, masked[:, :, unknowns:] @ amount, gain)


def _likely_lines(flow: _Flow, kind: Kind, extra: Array, own: list[Flags]) -> list[tuple[bool, float]]:
    """Return side and line, a part of the raw image, of the whole image and of the likeliest line in it.

    extra (N,): by how much likelier a break makes each flow; own: flags (N,) of each camera that may have it.
    """
    found, lines = [], np.arange(1, LINES)[:, None] / LINES
    for side in (False, True) if kind != "turned" else ():
        beyond = (flow.row >= lines) != side
        counts = np.array([[(beyond & each).sum(axis=1), (~beyond & each).sum(axis=1)] for each in own])
        least = np.array([LEAST_PART * each.sum() if kind == "torn" else LEAST // len(own) for each in own])
        gains = np.where((counts >= least[:, None, None]).all(axis=(0, 1)), beyond @ extra, -np.inf)
        found.append((float(gains.max()), (side, (1 + int(gains.argmax())) / LINES)))
    likeliest = [max(found)[1]] if found and max(found)[0] > 0 else []
    return likeliest if kind == "torn" else [(False, 0.0), *likeliest]


def _cost(parameters: int, flows: int) -> float:
    """Return the penalty of a displacement with so many parameters by so many flows, and of the choice."""
    return 0.5 * parameters * math.log(2 * flows) + math.log(CHOICES)


def _common(A: Array, y: Array) -> Array:
    """Return x (K,) that most of y - A x (N, 2) agree with."""
    along = np.swapaxes(A, 1, 2)
    each = np.linalg.solve(along @ A + RIDGE * np.eye(A.shape[2]), along @ y[:, :, None])[:, :, 0]
    return _robust(A, y, np.median(each, axis=0))


def _robust(A: Array, y: Array, x: Array) -> Array:
    """Return x (K,) that minimises the Geman-McClure cost of y - A x, A (N, 2, K), from a start."""
    for _ in range(ROUNDS):
        x = _least_squares(A, y, 1.0 / (1.0 + ((y - A @ x) ** 2).sum(axis=1) / 4.0) ** 2)
    return x


def _least_squares(A: Array, y: Array, weight: Array) -> Array:
    """Return x (K,) that minimises the sum of weights (N,) times |y - A x|^2; the seventh, the lag, has a prior."""
    size = A.shape[2]
    weighted, prior = (weight[:, None, None] * A).reshape(-1, size), np.full(size, RIDGE)
    prior[6:7] = 1.0
    return np.asarray(np.linalg.solve(weighted.T @ A.reshape(-1, size) + np.diag(prior), weighted.T @ y.ravel()))


def _words(found: Break, pairs: int = 1) -> str:
    """Return what a break was that so many pairs showed, and what to do."""
    cameras = camera_names(found.cameras)
    shown = "1 pair shows" if pairs == 1 else f"{pairs} pairs show"
    if found.kind == "torn":
        return (
            f"images of the {cameras} are torn at row {found.line_px}: what is below is of another moment than what is "
            f"above, as {shown}; check bandwidth and buffers, poses were degraded"
        )
    u, v = found.amount[:, :2].mean(axis=0)
    part = f" {'above' if found.is_before else 'below'} row {found.line_px}" if found.line_px else ""
    if not found.line_px and len(found.cameras) == 1:
        part = f" against those of the {CAMERAS[1 - found.cameras[0]]} one"
    turned = f" and turned by {math.degrees(found.amount[0, 2]):+.2f} deg" if found.kind == "turned" else ""
    return (
        f"images of the {cameras} were displaced by {u:+.1f}, {v:+.1f} px{turned}{part}, as {shown}: the rig does not "
        "fit them; check the mirror, the sensor's window and the driver, poses were degraded"
    )
