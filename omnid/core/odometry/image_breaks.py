"""Images that are whole, but not of one instant or of one geometry: torn, displaced, with lines missing or twice.

Landmarks flow from one pair to the next as the step of the rig says, and what is left of their flow is noise. In an
image that breaks at a line it is not: what lies beyond the line is displaced, or moves as the rig did one image before.
With the flow d_i of landmark i in the panorama of a camera, less the flow that the step predicts,

    H0:  d_i = J_i x + noise                                     x (6,): error of the step
    H1:  d_i = J_i x + [i lies beyond the line] F_i a + noise    in one camera, or in both

F_i a is either a shift in the raw image (its window moved, lines repeat or are missing), or a part of the step that led
to the pair or of the one before (what is beyond is of another image). Lines are rows or columns of the raw image, as a
sensor may be mounted on its side; a line at the edge is the whole image, which may be turned as well if a mirror moved.
The likeliest of all is compared with H0 by the Bayesian information criterion (Schwarz 1978). What moves in view, as
people do, does not end at a raw line; a rolling shutter makes a slope over the rows, not a step, and competes as such.

A break is an event: the flow shows it in the pair in which it begins, and once more where it ends. In between, the
landmarks that were seen since agree with it, and nothing shows it. So it stays until its opposite is seen.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Final, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from calib import se3
from omnid.core.odometry.local_map import LocalMap
from omnid.core.odometry.plane_patches import align, plane_templates
from omnid.core.odometry.pose_search import CORRELATED_LANDMARKS
from omnid.core.odometry.runner_up_motions import RUNNER_UP_COST
from omnid.core.odometry.tracking import KltSettings, track
from omnid.core.stereo.triangulation import view, view_jacobian
from omnid.core.types.panorama import PaddedPanorama
from omnid.core.types.stereo_model import StereoModel

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]
Indices = NDArray[np.intp]
Kind = Literal["torn", "displaced", "turned", "rolling"]

MOST: Final = 160  # landmarks that are followed in each camera
SIGMA_PX: Final = 0.1  # of a flow, because patches err by some hundredths, and people and shadows are near by
LAG_S: Final = 0.003  # standard deviation of the time between the exposures of two cameras that are triggered together
# Squared Mahalanobis distance of a flow, a sum of two squares, from which on it is an outlier, and costs no more.
OUTLIER_SQUARED: Final = 32.0
MOST_SCALE: Final = 25.0  # of the variance of flows: half a pixel; where it is larger, flows are displaced
GOOD_SHARE: Final = 0.2  # of the flows, that no break displaces: of one camera, or up to a line
LINES, BETWEEN = 24, 4  # lines that are tried, and those between two of them, of a break that was found
LEAST: Final = 8  # flows on either side of a line in the cameras of a break
# Cost of a landmark (`PoseEstimate.cost`) whose view has the noise that is expected: the mean of the Cauchy kernel's.
RIGHT_COST: Final = 0.31
FOLLOWED: Final = 0.2  # part of a new pair in the mean of the costs
FAR: Final = KltSettings(levels=2)  # 28 px
EDGE_PX: Final = 8  # of the panorama, in which patches are cut
LEAST_PX: Final = 0.5  # by which what is beyond a line is displaced: less harms no pose
LEAST_PART: Final = 0.5  # of a step, by which a part is displaced that is of another image; 1 / LEAST_PART at most
LEAST_SHARE: Final = 0.2  # of the other camera's displacement, below which a camera has none
ROUNDS: Final = 6
RIDGE: Final = 1e-6
CAMERAS: Final = ("lower", "upper")
ONE, EACH = ((0,), (1,)), ((0,), (1,), (0, 1))  # cameras of a break


class _Form(NamedTuple):
    """A form that a break may have: displacements along some of the columns of `_Flow.columns`."""

    kind: Kind
    axis: int  # of its line, 0: a row
    columns: tuple[int, ...]
    has_line: bool
    sets: tuple[tuple[int, ...], ...] = EACH


SHIFT, TURN, STEP, BEFORE, BOTH = (0, 1), 2, 3, 4, 5  # columns of flows
# A torn image shows a step less where it begins, one more where it ends, and both where it lasts. Both images turned
# alike are a turn of the rig. A rolling shutter makes a slope over rows (or columns) of both steps.
FORMS: Final = (
    *(_Form("torn", axis, (part,), True) for axis in (0, 1) for part in (STEP, BEFORE, BOTH)),
    *(_Form("displaced", axis, SHIFT, True) for axis in (0, 1)),
    *(_Form("rolling", axis, (6 + 2 * axis, 7 + 2 * axis), False) for axis in (0, 1)),
    _Form("displaced", 0, SHIFT, False),
    _Form("turned", 0, (*SHIFT, TURN), False, ONE),
)


class RawImage:
    """Where the raw image of a camera shows the pixels of its panorama."""

    def __init__(self, u: NDArray[np.float32], v: NDArray[np.float32], size: tuple[int, int]) -> None:
        """u, v (H, W): raw column and row of each pixel, -1: none; size: columns and rows of the raw image."""
        self._maps, self.size = (u, v), size

    def at(self, pixels: Array) -> tuple[Array, Array]:
        """Return raw pixels (N, 2) of pixels (N, 2), NaN: none, and the derivatives (N, 2, 2) of pixels by raw ones."""
        height, width = self._maps[0].shape
        column = np.clip(np.rint(pixels[:, 0]).astype(np.intp), 2, width - 3)
        row = np.clip(np.rint(pixels[:, 1]).astype(np.intp), 2, height - 3)
        raw = np.column_stack([table[row, column] for table in self._maps]).astype(float)
        across = np.column_stack([table[row, column + 2] - table[row, column - 2] for table in self._maps]) / 4.0
        down = np.column_stack([table[row + 2, column] - table[row - 2, column] for table in self._maps]) / 4.0
        determinant = across[:, 0] * down[:, 1] - across[:, 1] * down[:, 0]
        is_shown = (raw >= 0).all(axis=1) & (np.abs(determinant) > 1e-3)
        determinant = np.where(is_shown, determinant, 1.0)
        adjugate = np.array([[down[:, 1], -down[:, 0]], [-across[:, 1], across[:, 0]]])
        return np.where(is_shown[:, None], raw, np.nan), np.moveaxis(adjugate / determinant, 2, 0)


class Break(NamedTuple):
    """A break of the images of one camera, or of both, at a pair."""

    kind: Kind
    cameras: tuple[int, ...]  # 0: lower, 1: upper
    axis: int  # 0: the line is a row, 1: a column
    line_px: int  # of the raw image; 0: the whole image
    amount: Array  # (C, K) raw px, and turn, rad; or parts of the step to this pair or of the one before
    angle_rad: float  # by which what is beyond is displaced in view, mean
    is_before: bool = False  # what is before the line is displaced, and not what is beyond
    late: float = 0.0  # steps by which what is beyond is earlier now, and was not in the pair before

    def is_undone_by(self, other: Break) -> bool:
        """True if another break ends this one."""
        if (other.kind == "torn") != (self.kind == "torn") or not set(self.cameras) & set(other.cameras):
            return False
        if self.kind == "torn":  # an image that is torn in both pairs shows one step less and one more
            return self.late * other.late < 0 and abs(other.late) > 0.5
        mine, others = (found.amount[:, :2].mean(axis=0) for found in (self, other))
        return float(np.linalg.norm(mine + others)) < 0.5 * max(map(float, map(np.linalg.norm, (mine, others))))


class _View(NamedTuple):
    """A pair, and the landmarks that the map shows in it."""

    pair: tuple[PaddedPanorama, PaddedPanorama]
    T_odom_rect: Array
    points: Array  # (N, 3) m, in odom
    covariance: Array  # (N, 3, 3) m^2
    slopes: Array  # (N, 2) of the disparity, px/px
    step: Array  # (6,) that led to it


class _Flow(NamedTuple):
    """Flows of landmarks that are not explained by the step, in standard deviations; rows of all cameras."""

    y: Array  # (N, 2)
    null: Array  # (N, 2, 7) derivatives by the step's error, and by the lag of the upper camera
    # (N, 2, 10) by a shift and a turn of the raw image, by parts of the step, of that before, and of their difference,
    # and by both steps over the rows and columns of the raw image
    columns: Array
    camera: Indices  # (N,)
    place: Array  # (N, 2) in parts of the raw image: column, row
    px: Array  # (N,) standard deviations


@dataclass(slots=True)
class ImageBreaks:
    """Follows the breaks of a run from pair to pair."""

    model: StereoModel
    raws: tuple[RawImage, RawImage]
    covariance: Array = field(default_factory=lambda: np.zeros((6, 6)))  # [t; r] that breaks add to that of the pose
    fault: str = ""  # how the images of the last pair are broken, in words; empty: they are whole
    _last: _View | None = None
    _confirmed: Indices = field(default_factory=lambda: np.zeros(0, np.intp))  # ids of landmarks
    _open: list[Break] = field(default_factory=list)
    _usual_cost: float = RIGHT_COST  # of a landmark in whole images
    _found: dict[tuple[Kind, tuple[int, ...], int], list[Break]] = field(default_factory=dict)

    def add(
        self,
        seq: int,
        pair: tuple[PaddedPanorama, PaddedPanorama],
        T_odom_rect: Array,
        local_map: LocalMap,
        dt_s: float,
        cost: tuple[float, int] | None,
    ) -> None:
        """Use a pair (seq: its number) with its pose, dt_s after the one before.

        cost: mean of the landmarks in view, and their number, None: no pose was found. A break costs at least as much
        as it must explain to be believed: where the views fit as usual there is none, and no flow is measured.
        """
        last, found = self._last, None
        step = np.zeros(6) if last is None else se3.log(se3.inverse(last.T_odom_rect) @ T_odom_rect)
        is_usual = cost is not None and cost[1] * (cost[0] - self._usual_cost) < RUNNER_UP_COST and not self._open
        if last is not None and dt_s > 0 and not is_usual:
            flow = self._flow(last, pair, T_odom_rect, step, LAG_S / dt_s)
            found = None if flow is None else likeliest_break(flow, self.raws, self.model.cylinder.focal_px)
        if cost is not None and found is None:
            usual = self._usual_cost + FOLLOWED * (cost[0] - self._usual_cost)
            self._usual_cost = min(usual, RIGHT_COST)  # a run whose images are broken from the start is not usual
        self._spread(last, step, found)
        # Landmarks that were an inlier after they were added: of others the depth may be wrong, and so the flow.
        table = local_map.table
        is_confirmed = ((table.misses == 0) & (table.anchor != seq)) | np.isin(table.id, self._confirmed)
        self._confirmed = table.id[is_confirmed]
        rows, _ = local_map.visible(T_odom_rect)
        rows = rows[is_confirmed[rows]]
        rows = rows[:: max(1, -(-len(rows) // MOST))]
        slopes = local_map.slopes(T_odom_rect, rows)
        self._last = _View(pair, T_odom_rect, table.points[rows], table.covariance[rows], slopes, step)

    @property
    def words(self) -> list[str]:
        """One line for each kind of break and the cameras that showed it."""
        return [_words(breaks) for breaks in self._found.values()]

    def _spread(self, last: _View | None, step: Array, found: Break | None) -> None:
        """Add what a break makes uncertain.

        A torn image shows the rig up to an image too early, and landmarks are misplaced by as much. A displaced one
        turns directions, and moves the rig by as much of the landmarks' range.
        """
        if found is not None:
            key = found.kind, found.cameras, found.axis if found.line_px else 0
            self._found.setdefault(key, []).append(found)
            before = self._open
            self._open = [earlier for earlier in before if not earlier.is_undone_by(found)]
            is_known = any((each.kind, each.cameras) == ("torn", found.cameras) == key[:2] for each in self._open)
            if len(self._open) == len(before) and not is_known:
                self._open.append(found)
        now = [*self._open, *([] if found is None else [found])]
        self.fault = _words(now[-1:]) if now else ""
        if last is None or not (now or self.covariance.any()):
            return
        A = se3.adjoint(se3.exp(-step))
        self.covariance = A @ self.covariance @ A.T
        if any(broken.kind == "torn" for broken in now):
            self.covariance = self.covariance + np.outer(step, step) + np.outer(last.step, last.step)
        if found is not None and found.kind != "torn":
            away = se3.apply(se3.inverse(last.T_odom_rect), last.points)
            range_m = float(np.median(np.linalg.norm(away, axis=1)))
            self.covariance = self.covariance + found.angle_rad**2 * np.diag(np.repeat([range_m**2, 1.0], 3))

    def _flow(
        self, last: _View, pair: tuple[PaddedPanorama, PaddedPanorama], T_now: Array, step: Array, lag: float
    ) -> _Flow | None:
        """Return the flows of the last pair's landmarks; None: too few. lag: standard deviation in parts of a step."""
        cylinder, baseline_m = self.model.cylinder, self.model.baseline_m
        before, now = (se3.apply(se3.inverse(T), last.points) for T in (last.T_odom_rect, T_now))
        views = tuple(view(points, cylinder, baseline_m) for points in (before, now))
        J_before, J_now = (view_jacobian(points, cylinder, baseline_m) for points in (before, now))
        of_step = np.concatenate([np.broadcast_to(-np.eye(3), (len(now), 3, 3)), se3.hat(now)], axis=2)
        of_point = J_now @ T_now[:3, :3].T - J_before @ last.T_odom_rect[:3, :3].T
        parts = []
        for camera, raw_image in enumerate(self.raws):
            # 1. Landmarks that both pairs show, and where they are instead of where the step puts them.
            own = [0, 1 + camera]
            start, end = views[0][:, own], views[1][:, own]
            raw, by_raw = raw_image.at(end)
            inside = np.isfinite(raw).all(axis=1)
            for pixels in (start, end):
                inside &= (pixels[:, 1] > EDGE_PX) & (pixels[:, 1] < cylinder.height - EDGE_PX)
                inside &= cylinder.shows(pixels[:, 0])
            rows = np.flatnonzero(inside)
            there, found = self._found_at(camera, last, pair, T_now, before[rows], rows, (start[rows], end[rows]))
            rows, d = rows[found], there[found] - end[rows[found]]
            d[:, 0] = cylinder.wrap(d[:, 0])
            # 2. Derivatives, in standard deviations.
            noise = np.einsum("nij,njk,nik->ni", of_point[rows][:, own], last.covariance[rows], of_point[rows][:, own])
            px = np.sqrt(SIGMA_PX**2 + noise.mean(axis=1))
            J, shift = J_now[rows][:, own] @ of_step[rows] / px[:, None, None], by_raw[rows] / px[:, None, None]
            steps = np.stack([J @ step, J @ last.step, J @ (step - last.step)], axis=2)
            size = np.array(raw_image.size)
            arm, place = raw[rows] - (size - 1) / 2, raw[rows] / size
            turn = shift @ np.column_stack([-arm[:, 1], arm[:, 0]])[:, :, None]
            over = [(place[:, 1 - axis] - 0.5)[:, None, None] * steps[:, :, :2] for axis in (0, 1)]
            null = np.concatenate([J, lag * camera * steps[:, :, :1]], axis=2)
            columns = np.concatenate([shift, turn, steps, *over], axis=2)
            parts.append(_Flow(d / px[:, None], null, columns, np.full(len(rows), camera), place, px))
        flow = _Flow(*(np.concatenate(part) for part in zip(*parts, strict=True)))
        return flow if len(flow.y) >= 3 * LEAST else None

    def _found_at(
        self,
        camera: int,
        last: _View,
        pair: tuple[PaddedPanorama, PaddedPanorama],
        T_now: Array,
        before: Array,
        rows: Indices,
        seen: tuple[Array, Array],
    ) -> tuple[Array, Flags]:
        """Return the pixels (M, 2) of landmarks (rows (M,)) in a camera's panorama, and flags (M,): they were found.

        before (M, 3) [m]: in the last rectified frame; seen (M, 2), (M, 2): before, and as the step predicts. They are
        tracked from there, else as if the rig had stood, as torn images show it. Then their patches are aligned, bent
        as the step bends them; those that were not tracked where the step predicts them.
        """
        start, end = seen
        there, found = end.copy(), np.zeros(len(rows), bool)
        for guess in (end, start):
            rest = np.flatnonzero(~found)
            tracked, found[rest] = track(last.pair[camera], pair[camera], start[rest], guess[rest], FAR)
            there[found & np.isin(np.arange(len(rows)), rest)] = tracked[found[rest]]
        # The upper camera is like a lower one whose frame is higher, in which slopes are those over its own rows.
        up, slopes = np.eye(4), last.slopes[rows]
        if camera:
            up[2, 3] = -self.model.baseline_m
            slopes = slopes / (1.0 + slopes[:, 1:])
        T_now_last = np.tile(up @ se3.inverse(T_now) @ last.T_odom_rect @ se3.inverse(up), (len(rows), 1, 1))
        one, surfaces = np.zeros(len(rows), np.intp), (se3.apply(up, before), slopes)
        templates = plane_templates({0: last.pair[camera]}, one, start, surfaces, T_now_last, self.model, there)
        aligned = align(templates, pair[camera], there)
        return np.where(aligned.found[:, None], aligned.pixels, there), aligned.found | found


def likeliest_break(flow: _Flow, raws: tuple[RawImage, RawImage], focal_px: float) -> Break | None:
    """Return the break that flows show beyond doubt; None: there is none."""
    # 1. The null hypothesis, robustly, from no error and from that of all flows; the scale of what it leaves.
    y, null = flow.y, flow.null
    starts = (np.zeros(null.shape[2]), _least_squares(null, y, np.ones(len(y))))
    lefts = [y - null @ _robust(null, y, start) for start in starts]
    squares = [(left**2).sum(axis=1) for left in lefts]
    # A step that is wrong must explain much more to be believed.
    costs = [np.minimum(each, OUTLIER_SQUARED * MOST_SCALE).sum() for each in squares]
    best = int(costs[1] < costs[0] / 2)
    left, squared = lefts[best], squares[best]
    # So many sums of two squares of unit variance are below -2 log(1 - GOOD_SHARE).
    scale = float(np.clip(np.quantile(squared, GOOD_SHARE) / (-2 * math.log(1 - GOOD_SHARE)), 1.0, MOST_SCALE))
    outlier = OUTLIER_SQUARED * scale
    if np.minimum(squared, outlier).sum() / (2 * scale * CORRELATED_LANDMARKS) < RUNNER_UP_COST + _cost(2, len(y)):
        return None  # no break explains more than all that is left
    # 2. Of its outliers, those that one other motion explains belong to a part; others, as people, to none.
    used = squared < outlier
    most_off = int(np.bincount(flow.camera[~used], minlength=2).argmax())
    for cameras in EACH:
        rest = np.flatnonzero((squared >= outlier) & np.isin(flow.camera, cameras))
        if len(rest) < LEAST:
            continue
        for own in (SHIFT, (TURN,), (STEP,), (BEFORE,), (BOTH,)):
            F, off = flow.columns[rest][:, :, own], left[rest]
            along = np.swapaxes(F, 1, 2)
            each = np.linalg.solve(along @ F + RIDGE * np.eye(len(own)), along @ off[:, :, None])[:, :, 0]
            amount = _robust(F, off, np.median(each, axis=0))
            used[rest] |= ((off - F @ amount) ** 2).sum(axis=1) < outlier
    # 3. The likeliest line of each form, by least squares; the robust likelihood of each, also at the lines next to it.
    found: tuple[float, _Candidate, Array, Array] | None = None
    for form in FORMS:
        likely = [each for each in _candidates(form, flow, used, left, scale) if each.gain > RUNNER_UP_COST]
        # One image displaced is the other one displaced the other way, and a step: it is that in which the step is not.
        likely = [each for each in likely if each.line or form.has_line or each.cameras != (1 - most_off,)]
        first = max(likely, key=lambda each: each.gain, default=None)
        for line in () if first is None else first.near_lines():
            assert first is not None
            candidate = first._replace(line=line)
            tried = np.concatenate([null, candidate.columns(flow)], axis=2)
            solution = _robust(tried, y, _least_squares(tried, y, used.astype(float)))
            rest_squared = ((y - tried @ solution) ** 2).sum(axis=1)
            gained = float((np.minimum(squared, outlier) - np.minimum(rest_squared, outlier)).sum())
            gain = gained / (2 * scale * CORRELATED_LANDMARKS) - _cost(tried.shape[2] - null.shape[2], int(used.sum()))
            if found is None or gain > found[0]:
                found = gain, candidate, solution[null.shape[2] :], tried[:, :, null.shape[2] :]
    return None if found is None or found[0] < RUNNER_UP_COST else _break(flow, raws, focal_px, *found[1:])


def _break(
    flow: _Flow, raws: tuple[RawImage, RawImage], focal_px: float, best: _Candidate, solution: Array, columns: Array
) -> Break | None:
    """Return the break of the likeliest candidate; None: it is a rolling shutter, or too small to harm a pose."""
    form, amount = best.form, solution.reshape(len(best.cameras), -1)
    if form.kind == "rolling" or (form.kind == "torn" and not _is_a_step(np.abs(amount).max(keepdims=True)).all()):
        return None
    # Cameras that have a share in it.
    moved_px = np.linalg.norm((columns @ solution) * flow.px[:, None], axis=1)
    mean_px = [float(moved_px[(flow.camera == camera) & (moved_px > 0)].mean()) for camera in best.cameras]
    shares = [number for number, px in enumerate(mean_px) if px > LEAST_SHARE * max(mean_px)]
    if max(mean_px) < LEAST_PX:
        return None
    cameras, is_late = tuple(best.cameras[number] for number in shares), form.columns[0] in (STEP, BEFORE)
    line_px = round(best.line * raws[cameras[0]].size[1 - form.axis])
    late = -float(amount[shares].mean()) if form.kind == "torn" and is_late else 0.0
    return Break(form.kind, cameras, form.axis, line_px, amount[shares], max(mean_px) / focal_px, best.is_before, late)


def _is_a_step(parts: Array) -> Flags:
    """True where a part (M,) of a step is about a step: a rolling shutter displaces by less."""
    return np.asarray((parts > LEAST_PART) & (parts < 1.0 / LEAST_PART))


class _Candidate(NamedTuple):
    gain: float
    form: _Form
    cameras: tuple[int, ...]
    line: float  # part of the raw image that is before the line; 0: the break is of the whole image
    is_before: bool = False  # what is before the line is displaced

    def columns(self, flow: _Flow) -> Array:
        """Return the derivatives (N, 2, C K) of flows by the amounts of each camera."""
        where = (flow.place[:, 1 - self.form.axis] >= self.line) != self.is_before
        return np.asarray(_of_cameras(flow, self.form, self.cameras) * where[:, None, None])

    def near_lines(self) -> list[float]:
        """Return the line and those up to the next ones that were tried."""
        if not self.form.has_line:
            return [self.line]
        return [self.line + k / (LINES * BETWEEN) for k in range(1 - BETWEEN, BETWEEN)]


def _of_cameras(flow: _Flow, form: _Form, cameras: tuple[int, ...]) -> Array:
    """Return the derivatives (N, 2, C K) of flows in the whole image by the amounts of a form in each camera."""
    F = flow.columns[:, :, form.columns]
    return np.concatenate([F * (flow.camera == camera)[:, None, None] for camera in cameras], axis=2)


def _candidates(form: _Form, flow: _Flow, used: Flags, left: Array, scale: float) -> Iterator[_Candidate]:
    """Yield the likeliest line of a form for each set of cameras and side, by least squares over the flows used.

    What a break explains beyond the null hypothesis is b^T S^-1 b, b the products of its columns with what that leaves,
    S those of the columns with each other, without what the null hypothesis explains of them.
    """
    m, lines = flow.null.shape[2], np.arange(LINES if form.has_line else 1) / LINES
    null = flow.null[used].reshape(-1, m)
    information = np.linalg.inv(null.T @ null + np.diag(_prior(m)))
    left = left - flow.null @ (information @ (null.T @ left[used].ravel()))
    beyond = flow.place[:, 1 - form.axis] >= lines[:, None]
    for cameras in form.sets:
        F = _of_cameras(flow, form, cameras)
        size, own = F.shape[2], np.isin(flow.camera, cameras)
        products = np.swapaxes(F, 1, 2) @ np.concatenate([F, flow.null, left[:, :, None]], axis=2)
        for is_before in (False, True) if form.has_line else (False,):
            # 1. Sums of the products of all columns for the flows of each side.
            side = (beyond != is_before) & used
            sums = (side.astype(float) @ products.reshape(len(own), -1)).reshape(len(lines), size, -1)
            with_null, b = sums[:, :, size : size + m], sums[:, :, -1:]
            S = sums[:, :, :size] - with_null @ information @ np.swapaxes(with_null, 1, 2) + RIDGE * np.eye(size)
            # 2. What each line explains.
            amount = np.linalg.solve(S, b)
            most = np.linalg.norm(amount.reshape(len(lines), len(cameras), -1), axis=2).max(axis=1)
            good = np.ones(len(lines), bool)
            for camera in cameras:
                in_camera = flow.camera == camera
                here, elsewhere = (side & in_camera).sum(axis=1), (~side & used & in_camera).sum(axis=1)
                enough = LEAST // len(cameras)
                good &= (here >= enough) & ((elsewhere >= enough) | (not form.has_line))
            if form.kind == "torn":
                good &= _is_a_step(most)
            if form.kind == "displaced" and form.has_line:  # lines that are twice or missing are whole ones
                good &= most > LEAST_PX
            gain = (b * amount).sum(axis=(1, 2)) / (2 * scale * CORRELATED_LANDMARKS) - _cost(size, int(used.sum()))
            line = int(np.where(good, gain, -np.inf).argmax())
            if good[line]:
                yield _Candidate(float(gain[line]), form, cameras, float(lines[line]), is_before)


def _cost(parameters: int, flows: int) -> float:
    """Return the penalty of a break with so many parameters by so many flows of two components, and of the choice."""
    return 0.5 * parameters * math.log(2 * flows) + math.log(len(FORMS) * len(EACH) * LINES)


def _robust(A: Array, y: Array, x: Array) -> Array:
    """Return x (K,) that minimises the Geman-McClure cost of y - A x, A (N, 2, K), from a start."""
    for _ in range(ROUNDS):
        x = _least_squares(A, y, 1.0 / (1.0 + ((y - A @ x) ** 2).sum(axis=1) / 4.0) ** 2)
    return x


def _least_squares(A: Array, y: Array, weight: Array) -> Array:
    """Return x (K,) that minimises the sum of weights (N,) times |y - A x|^2, with the prior of the null hypothesis."""
    size = A.shape[2]
    weighted = (weight[:, None, None] * A).reshape(-1, size)
    return np.asarray(np.linalg.solve(weighted.T @ A.reshape(-1, size) + np.diag(_prior(size)), weighted.T @ y.ravel()))


def _prior(size: int) -> Array:
    """Return the information (K,) that there is on parameters: of those of the null hypothesis, on the lag."""
    prior = np.full(size, RIDGE)
    prior[6:7] = 1.0
    return prior


def _words(breaks: list[Break]) -> str:
    """Return what breaks of one kind in the same cameras were, and what to do."""
    newest = breaks[0]
    names = [CAMERAS[camera] for camera in newest.cameras]
    cameras = " and the ".join(names) + (" cameras" if len(names) > 1 else " camera")
    line, beyond, before = ("row", "below", "above") if newest.axis == 0 else ("column", "right of", "left of")
    place = f"{line} {round(float(np.median([found.line_px for found in breaks])))}"
    shown = "1 pair shows" if len(breaks) == 1 else f"{len(breaks)} pairs show"
    if newest.kind == "torn":
        return (
            f"images of the {cameras} are torn at {place}: what is {beyond} is of another moment than what is "
            f"{before}, as {shown}; check bandwidth and buffers, poses were degraded"
        )
    u, v = newest.amount[:, :2].mean(axis=0)
    part = f" {before if newest.is_before else beyond} {line} {newest.line_px}" if newest.line_px else ""
    if not newest.line_px and len(names) == 1:
        part = f" against those of the {CAMERAS[1 - newest.cameras[0]]} one"
    turned = f" and turned by {math.degrees(newest.amount[0, 2]):+.2f} deg" if newest.kind == "turned" else ""
    return (
        f"images of the {cameras} were displaced by {u:+.1f}, {v:+.1f} px{turned}{part}, as {shown}: the rig does not "
        "fit them; check the mirror, the sensor's window and the driver, poses were degraded"
    )
