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
from collections import Counter
from dataclasses import dataclass, field
from typing import Final, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from calib import se3
from omnid.core.odometry.local_map import LocalMap
from omnid.core.odometry.plane_patches import AlignedPatches, align, plane_templates
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
GOOD_SQUARED: Final = -2 * math.log(1 - GOOD_SHARE)  # below which so many sums of two squares of unit variance are
LINES: Final = 24  # lines that are tried: each has some ten landmarks between it and the next
NEXT: Final = 4  # lines between two of these that are tried of a break that was found
STEADY_PX: Final = 64  # spread of lines that are one line in the words about them
LEAST, LEAST_EACH = 8, 3  # landmarks on either side of a line in the cameras, and in each
# Flows that count as one, as landmarks' errors do in the covariance of a pose.
CORRELATED: Final = 4.0
# Cost of a landmark (`PoseEstimate.cost`) whose view has the noise that is expected: the mean of the Cauchy kernel's.
RIGHT_COST: Final = 0.31
FOLLOWED: Final = 0.1  # part of a new pair in the mean of the costs
SURE: Final = math.log(1e6)  # least logarithm of the ratio of likelihoods: a false one in some days of driving
# Landmarks whose patch is not near the prediction, as a share, from which on they are searched farther away. In right
# images it is below 0.1.
SEARCHED_SHARE: Final = 0.15
FAR: Final = KltSettings(levels=2)  # 28 px
EDGE_PX: Final = 8  # of the panorama, in which patches are cut
REACH_PX: Final = 2
SURE_PX: Final = 0.5  # by which a patch is off at most where no other place is tried
KERNEL_WIDTH: Final = 2.0
LEAST_PX: Final = 0.5  # by which what is beyond a line is displaced: less harms no pose
LEAST_PART: Final = 0.5  # of a step, by which a part is displaced that is of another image
LEAST_SHARE: Final = 0.2  # of the other camera's displacement, below which a camera has none
ROUNDS: Final = 6
RIDGE: Final = 1e-6
LAG: Final = 6  # number of the lag among the parameters of the null hypothesis
CAMERAS: Final = ("lower", "upper")
SETS: Final[tuple[tuple[int, ...], ...]] = ((0,), (1,), (0, 1))
BOTH_STEPS: Final = 2  # number of the difference of two steps among the parts of steps


class _Form(NamedTuple):
    """A form that a break may have."""

    kind: Kind
    axis: int  # of its line, 0: a row
    lines: int  # that are tried
    sets: tuple[tuple[int, ...], ...] = SETS
    others: tuple[tuple[int, ...], ...] = ()  # cameras of which what is before the line may be displaced instead
    column: int = 0  # of the parts of steps


# A torn image shows a step less where it begins, one more where it ends, and both where it lasts. Both images turned
# alike are a turn of the rig.
FORMS: Final = (
    *(_Form("torn", axis, LINES, SETS, SETS[:2], column) for axis in (0, 1) for column in range(BOTH_STEPS + 1)),
    *(_Form("displaced", axis, LINES, SETS, SETS[:2]) for axis in (0, 1)),
    *(_Form("rolling", axis, 1) for axis in (0, 1)),
    _Form("displaced", 0, 1),
    _Form("turned", 0, 1, SETS[:2]),
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
    amount: Array  # (C, 2) raw px, or parts of the step to this pair and of the one before; (C, 3): and turn, rad
    angle_rad: float  # by which what is beyond is displaced in view, mean
    evidence: float  # logarithm of the ratio of likelihoods
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
    """Flows of landmarks that are not explained by the step, whitened; rows of all cameras."""

    y: Array  # (N, 2)
    null: Array  # (N, 2, 7) derivatives by the step's error, and by the lag of the upper camera
    shift: Array  # (N, 2, 2) by a shift in the raw image
    steps: Array  # (N, 2, 3) by parts of the step, of that before, and of their difference
    turn: Array  # (N, 2, 1) by a turn of the raw image about its middle
    camera: Indices  # (N,)
    raw: Array  # (N, 2) px
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
    _pairs: Counter[tuple[Kind, tuple[int, ...], int]] = field(default_factory=Counter)
    _lines: dict[tuple[Kind, tuple[int, ...], int], list[Break]] = field(default_factory=dict)

    def add(
        self,
        seq: int,
        pair: tuple[PaddedPanorama, PaddedPanorama],
        T_odom_rect: Array,
        local_map: LocalMap,
        dt_s: float,
        cost: tuple[float, int] | None,
    ) -> Break | None:
        """Use a pair (seq: its number) with its pose, dt_s after the one before; return the break that it shows.

        cost: mean of the landmarks in view, and their number, None: no pose was found. A break costs at least as much
        as it must explain to be believed: where the views fit as usual there is none, and no flow is measured.
        """
        last, found = self._last, None
        step = np.zeros(6) if last is None else se3.log(se3.inverse(last.T_odom_rect) @ T_odom_rect)
        is_usual = cost is not None and cost[1] * (cost[0] - self._usual_cost) < SURE and not self._open
        if last is not None and dt_s > 0 and not is_usual:
            flow = self._flow(last, pair, T_odom_rect, step, LAG_S / dt_s)
            found = None if flow is None else likeliest_break(flow, self.raws, self.model.cylinder.focal_px)
        if cost is not None and found is None:
            usual = self._usual_cost + FOLLOWED * (cost[0] - self._usual_cost)
            self._usual_cost = min(usual, RIGHT_COST)  # a run whose images are broken from the start is not usual
        self._spread(last, step, found)
        # Landmarks that were an inlier after they were added: of others the depth may be wrong, and so the flow.
        table = local_map.store.table
        is_confirmed = ((table.misses == 0) & (table.anchor != seq)) | np.isin(table.id, self._confirmed)
        self._confirmed = table.id[is_confirmed]
        rows, _ = local_map.visible(T_odom_rect)
        rows = rows[is_confirmed[rows]]
        rows = rows[:: max(1, -(-len(rows) // MOST))]
        slopes = local_map.slopes(T_odom_rect, rows)
        self._last = _View(pair, T_odom_rect, table.points[rows], table.covariance[rows], slopes, step)
        return found

    @property
    def words(self) -> list[str]:
        """One line for each kind of break and the cameras that showed it."""
        return [_words(breaks, self._pairs[key]) for key, breaks in self._lines.items()]

    def _spread(self, last: _View | None, step: Array, found: Break | None) -> None:
        """Add what a break makes uncertain.

        A torn image shows the rig up to an image too early, and landmarks are misplaced by as much. A displaced one
        turns directions, and moves the rig by as much of the landmarks' range.
        """
        if found is not None:
            key = found.kind, found.cameras, found.axis if found.line_px else 0
            self._pairs[key] += 1
            self._lines.setdefault(key, []).append(found)
            undone = [earlier for earlier in self._open if earlier.is_undone_by(found)]
            for earlier in undone:
                self._open.remove(earlier)
            if not undone and not any(_is_same(earlier, found) for earlier in self._open):
                self._open.append(found)
        now = [*self._open, *([] if found is None else [found])]
        self.fault = _words(now[-1:], 1) if now else ""
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
        T_last = last.T_odom_rect
        before, now = (se3.apply(se3.inverse(T), last.points) for T in (T_last, T_now))
        views = tuple(view(points, cylinder, baseline_m) for points in (before, now))
        J_before, J_now = (view_jacobian(points, cylinder, baseline_m) for points in (before, now))
        of_step = np.concatenate([np.broadcast_to(-np.eye(3), (len(now), 3, 3)), se3.hat(now)], axis=2)
        of_point = J_now @ T_now[:3, :3].T - J_before @ T_last[:3, :3].T
        parts = []
        for camera in (0, 1):
            # 1. Landmarks that both pairs show, and where the step puts them.
            own = [0, 1 + camera]
            start, end = views[0][:, own], views[1][:, own]
            raw, by_raw = self.raws[camera].at(end)
            inside = np.isfinite(raw).all(axis=1)
            for pixels in (start, end):
                inside &= (pixels[:, 1] > EDGE_PX) & (pixels[:, 1] < cylinder.height - EDGE_PX)
                inside &= cylinder.shows(pixels[:, 0])
            rows = np.flatnonzero(inside)
            # 2. Where they are.
            there, found = self._found(camera, last, pair, T_now, before, rows, (start, end))
            rows, d = rows[found], there[found] - end[rows[found]]
            d[:, 0] = cylinder.wrap(d[:, 0])
            # 3. Derivatives, in standard deviations.
            noise = np.einsum("nij,njk,nik->ni", of_point[rows][:, own], last.covariance[rows], of_point[rows][:, own])
            px = np.sqrt(SIGMA_PX**2 + noise.mean(axis=1))
            J = J_now[rows][:, own] @ of_step[rows] / px[:, None, None]
            shift = by_raw[rows] / px[:, None, None]
            steps = np.stack([J @ step, J @ last.step, J @ (step - last.step)], axis=2)
            arm = raw[rows] - (np.array(self.raws[camera].size) - 1) / 2
            turn = shift @ np.column_stack([-arm[:, 1], arm[:, 0]])[:, :, None]
            null = np.concatenate([J, lag * camera * steps[:, :, :1]], axis=2)
            parts.append(_Flow(d / px[:, None], null, shift, steps, turn, np.full(len(rows), camera), raw[rows], px))
        flow = _Flow(*(np.concatenate(part) for part in zip(*parts, strict=True)))
        return flow if len(flow.y) >= 3 * LEAST else None

    def _found(
        self,
        camera: int,
        last: _View,
        pair: tuple[PaddedPanorama, PaddedPanorama],
        T_now: Array,
        before: Array,
        rows: Indices,
        views: tuple[Array, Array],
    ) -> tuple[Array, Flags]:
        """Return the pixels (M, 2) of landmarks (rows (M,)) in a camera's panorama, and flags (M,): they were found.

        Their patches in the last one are bent as the step bends them. The upper camera is like a lower one whose frame
        is higher by the baseline, in which slopes are those over its own rows.
        """
        there, off_px = np.full((len(rows), 2), np.nan), np.full(len(rows), np.inf)
        T_as_before = last.T_odom_rect @ se3.exp(last.step)
        # 1. As the step predicts; else as if the rig had stood, or gone on as before: what a torn image shows.
        for T in (T_now, last.T_odom_rect, T_as_before):
            rest = np.flatnonzero(off_px > SURE_PX)
            if len(rest) < LEAST:
                break
            end, aligned = self._aligned(camera, last, pair, T, before, rows[rest])
            by_px = np.where(aligned.found, np.linalg.norm(aligned.pixels - end, axis=1), np.inf)
            nearer = by_px < off_px[rest]
            there[rest[nearer]], off_px[rest[nearer]] = aligned.pixels[nearer], by_px[nearer]
        found = np.isfinite(off_px)
        # 2. Else farther away: what a displaced image shows.
        for T in (T_now, T_as_before):
            rest = np.flatnonzero(~found)
            if len(rest) > SEARCHED_SHARE * len(rows):
                own = [0, 1 + camera]
                end = self._views(se3.apply(se3.inverse(T), last.points[rows[rest]]))[:, own]
                tracked, is_good = track(last.pair[camera], pair[camera], views[0][rows[rest]], end, FAR)
                there[rest[is_good]], found[rest[is_good]] = tracked[is_good], True
        return there, found

    def _aligned(
        self,
        camera: int,
        last: _View,
        pair: tuple[PaddedPanorama, PaddedPanorama],
        T_now: Array,
        before: Array,
        rows: Indices,
    ) -> tuple[Array, AlignedPatches]:
        """Return where patches of landmarks (rows (M,)) are in a camera's panorama if the rig is at T_now: (M, 2) px.

        Also where they are found near by.
        """
        up, slopes = np.eye(4), last.slopes[rows]
        if camera:
            up[2, 3] = -self.model.baseline_m
            slopes = slopes / (1.0 + slopes[:, 1:])
        T_now_last = up @ se3.inverse(T_now) @ last.T_odom_rect @ se3.inverse(up)
        one, points = np.zeros(len(rows), np.intp), se3.apply(up, before[rows])
        start, end = (self.model.cylinder.pixels(each) for each in (points, se3.apply(T_now_last, points)))
        moved, surfaces = np.tile(T_now_last, (len(rows), 1, 1)), (points, slopes)
        templates = plane_templates({0: last.pair[camera]}, one, start, surfaces, moved, self.model, end)
        return end, align(templates, pair[camera], end, one, REACH_PX)

    def _views(self, points: Array) -> Array:
        return view(points, self.model.cylinder, self.model.baseline_m)


def likeliest_break(flow: _Flow, raws: tuple[RawImage, RawImage], focal_px: float) -> Break | None:
    """Return the break that flows show beyond doubt; None: there is none."""
    y, null = flow.y, flow.null
    # 1. The null hypothesis, robustly; the scale of what it leaves.
    size = null.shape[2]
    weak = null.reshape(-1, size)
    information = weak.T @ weak + np.diag(_prior(size))
    everywhere: Array = np.asarray(np.linalg.solve(information, weak.T @ y.ravel()), float)
    nowhere: Array = np.zeros(size)
    solutions = [_robust(null, y, start) for start in (nowhere, everywhere)]
    lefts = [y - null @ solution for solution in solutions]
    costs = [np.minimum((each**2).sum(axis=1), OUTLIER_SQUARED * MOST_SCALE).sum() for each in lefts]
    x, left = (each[int(np.argmin(costs))] for each in (solutions, lefts))
    squared = (left**2).sum(axis=1)
    scale = float(np.clip(np.quantile(squared, GOOD_SHARE) / GOOD_SQUARED, 1.0, MOST_SCALE))
    outlier = OUTLIER_SQUARED * scale
    used = squared < outlier
    most_off = int(np.bincount(flow.camera[~used], minlength=2).argmax())
    least_cost = _cost(2, len(y))
    if np.minimum(squared, outlier).sum() / (2 * scale * CORRELATED) < SURE + least_cost:
        return None  # no break explains more than all that is left
    # 2. Of its outliers, those that one other motion explains belong to a part; others, as people, to none.
    for cameras in SETS:
        rest = np.flatnonzero((squared >= outlier) & np.isin(flow.camera, cameras))
        if len(rest) < LEAST:
            continue
        each = np.linalg.solve(flow.shift[rest] + RIDGE * np.eye(2), left[rest][:, :, None])[:, :, 0]
        starts = [(flow.shift[rest], np.median(each, axis=0))]
        for other in (*np.moveaxis(flow.steps[rest], 2, 0), flow.turn[rest][:, :, 0]):
            along = (other * left[rest]).sum(axis=1) / np.maximum((other**2).sum(axis=1), RIDGE)
            starts.append((other[:, :, None], np.array([np.median(along)])))
        for columns, start in starts:
            amount = _robust(columns, left[rest], start)
            used[rest] |= ((left[rest] - columns @ amount) ** 2).sum(axis=1) < outlier
    # 3. The likeliest line of each kind, by least squares.
    likely = [candidate for candidate in _candidates(flow, used, left, scale, raws) if candidate.gain >= SURE]
    # One image displaced is the other one displaced the other way, and a step: it is that in which the step is not.
    likely = [each for each in likely if each.part or each.form.lines > 1 or each.cameras != (1 - most_off,)]
    if not any(candidate.form.kind != "rolling" for candidate in likely):
        return None
    # 4. The robust likelihood of each, also at the lines next to it.
    gained, columns, both, best = -math.inf, null, x, likely[0]
    for form in FORMS:
        first = max((candidate for candidate in likely if candidate.form == form), key=_gain, default=None)
        between = np.arange(-NEXT, NEXT + 1) / (LINES * NEXT)
        if first is None:
            continue
        for part in first.part + between if first.part else [0.0]:
            candidate = first._replace(part=float(part))
            tried = np.concatenate([null, *candidate.columns(flow, raws)], axis=2)
            size = tried.shape[2]
            start = np.linalg.lstsq(tried[used].reshape(-1, size), y[used].ravel(), rcond=None)[0]
            solution = _robust(tried, y, start)
            rest = ((y - tried @ solution) ** 2).sum(axis=1)
            gain = float((np.minimum(squared, outlier) - np.minimum(rest, outlier)).sum())
            gain = gain / (2 * scale * CORRELATED) - candidate.cost
            if gain > gained:
                gained, columns, both, best = gain, tried, solution, candidate
    amount = both[null.shape[2] :].reshape(len(best.cameras), -1)
    form = best.form
    if gained < SURE or form.kind == "rolling" or (form.kind == "torn" and not _is_a_step(amount)):
        return None
    # 5. Cameras that have a share in it.
    moved = (columns[:, :, null.shape[2] :] @ both[null.shape[2] :]) * flow.px[:, None]
    moved_px = np.linalg.norm(moved, axis=1)
    mean_px = [float(moved_px[(flow.camera == camera) & (moved_px > 0)].mean()) for camera in best.cameras]
    shares = [number for number, px in enumerate(mean_px) if px > LEAST_SHARE * max(mean_px)]
    cameras = tuple(best.cameras[number] for number in shares)
    if max(mean_px) < LEAST_PX:
        return None
    line_px = round(best.part * raws[cameras[0]].size[1 - form.axis])
    angle_rad = max(mean_px) / focal_px
    late = (0.0 if form.column == BOTH_STEPS else -float(amount[shares].mean())) if form.kind == "torn" else 0.0
    return Break(form.kind, cameras, form.axis, line_px, amount[shares], angle_rad, gained, best.is_before, late)


def _is_a_step(amount: Array) -> bool:
    """True if a part is displaced by about a step in one of the cameras: a rolling shutter displaces it by less."""
    return LEAST_PART < float(np.abs(amount).max()) < 1.0 / LEAST_PART


class _Candidate(NamedTuple):
    gain: float
    form: _Form
    cameras: tuple[int, ...]
    part: float  # of the raw image that is before the line; 0: the break is of the whole image
    cost: float
    is_before: bool = False  # what is before the line is displaced

    def columns(self, flow: _Flow, raws: tuple[RawImage, RawImage]) -> list[Array]:
        """Return the derivatives (N, 2, K) of flows by the amount of each camera."""
        of = _columns(flow, raws)[:, :, _own_columns(self.form)]
        sizes = np.array([raw.size[1 - self.form.axis] for raw in raws])
        where = (flow.raw[:, 1 - self.form.axis] >= self.part * sizes[flow.camera]) != self.is_before
        return [of * (where & (flow.camera == camera))[:, None, None] for camera in self.cameras]


def _gain(candidate: _Candidate) -> float:
    return candidate.gain


def _columns(flow: _Flow, raws: tuple[RawImage, RawImage]) -> Array:
    """Return the derivatives (N, 2, 10) of flows: by shift and turn, parts of steps, slopes over rows and columns."""
    slopes = []
    for axis in (0, 1):
        along = np.array([raw.size[1 - axis] for raw in raws])[flow.camera]
        slopes.append((flow.raw[:, 1 - axis] / along - 0.5)[:, None, None] * flow.steps[:, :, :2])
    return np.concatenate([flow.shift, flow.turn, flow.steps, *slopes], axis=2)


def _own_columns(form: _Form) -> slice:
    """Return which of these columns the amount of a form of break has."""
    match form.kind:
        case "displaced":
            return slice(2)
        case "turned":
            return slice(3)
        case "torn":
            return slice(3 + form.column, 4 + form.column)
        case "rolling":
            return slice(6 + 2 * form.axis, 8 + 2 * form.axis)


def _candidates(
    flow: _Flow, used: Flags, left: Array, scale: float, raws: tuple[RawImage, RawImage]
) -> list[_Candidate]:
    """Return the likeliest line of each form and set of cameras, by least squares over the flows that are used.

    What a break explains beyond the null hypothesis is b^T S^-1 b, b the products of its columns with what that leaves,
    S those of the columns with each other, without what the null hypothesis explains of them.
    """
    found: list[_Candidate] = []
    m, count = flow.null.shape[2], int(used.sum())
    null = flow.null[used].reshape(-1, m)
    information = np.linalg.inv(null.T @ null + np.diag(_prior(m)))
    left = left - flow.null @ (information @ (null.T @ left[used].ravel()))
    # 1. Sums of products of all columns for the landmarks beyond each line, by axis.
    columns = _columns(flow, raws)
    products = np.swapaxes(columns, 1, 2) @ np.concatenate([columns, flow.null, left[:, :, None]], axis=2)
    sums = [_beyond_lines(flow, used, products, axis, raws) for axis in (0, 1)]
    width = columns.shape[2]
    for form in FORMS:
        own_columns = _own_columns(form)
        k = own_columns.stop - (own_columns.start or 0)
        beyond, after = (part[:, : form.lines] for part in sums[form.axis])
        enough = {cameras: _enough(after[list(cameras)]) for cameras in SETS}
        systems: dict[bool, tuple[Array, Array]] = {}  # normal equations of both cameras: what is beyond, or before
        # 2. What each break explains. One of both cameras alike is the same on either side of its line, but for a step.
        for is_before, cameras in [(False, each) for each in form.sets] + [(True, each) for each in form.others]:
            if not enough[cameras].any():
                continue
            if is_before not in systems:
                own = beyond[:, :, own_columns]
                own = own[:, :1] - own if is_before else own
                with_null = np.moveaxis(own[..., width : width + m], 0, 1).reshape(form.lines, 2 * k, m)
                S = RIDGE * np.eye(2 * k) - with_null @ information @ np.swapaxes(with_null, 1, 2)
                for camera, block in enumerate((slice(k), slice(k, 2 * k))):
                    S[:, block, block] += own[camera][:, :, own_columns]
                systems[is_before] = S, np.moveaxis(own[..., -1], 0, 1).reshape(form.lines, 2 * k)
            S, b = systems[is_before]
            chosen, is_good = slice(k * cameras[0], k * (cameras[-1] + 1)), enough[cameras]
            b, size = b[:, chosen], k * len(cameras)
            amount = np.linalg.solve(S[:, chosen, chosen], b[:, :, None])[:, :, 0]
            if form.kind == "torn":
                most = np.abs(amount).max(axis=1)
                is_good = is_good & (most > LEAST_PART) & (most < 1.0 / LEAST_PART)
            if form.kind == "displaced" and form.lines > 1:  # lines that are twice or missing are whole ones
                is_good = is_good & (np.linalg.norm(amount.reshape(form.lines, -1, 2), axis=2).max(axis=1) > LEAST_PX)
            cost = _cost(size, count)
            gain = np.where(is_good, (b * amount).sum(axis=1) / (2 * scale * CORRELATED) - cost, -np.inf)
            line = int(gain.argmax())
            if is_good[line]:
                found.append(_Candidate(float(gain[line]), form, cameras, line / form.lines, cost, is_before))
    return found


def _enough(beyond: Array) -> Flags:
    """True (L,) for the lines that have enough flows on either side, by the numbers (C, L) beyond them by camera."""
    before = beyond[:, :1] - beyond if beyond.shape[1] > 1 else beyond
    sides = [(side.sum(axis=0) >= LEAST) & (side.min(axis=0) >= LEAST_EACH) for side in (beyond, before)]
    return np.asarray(sides[0] & sides[1])


def _beyond_lines(
    flow: _Flow, used: Flags, products: Array, axis: int, raws: tuple[RawImage, RawImage]
) -> tuple[Array, Array]:
    """Return sums of products (2, LINES, K, M) and numbers (2, LINES) of the flows beyond each line, by camera."""
    beyond, after = np.zeros((2, LINES, *products.shape[1:])), np.zeros((2, LINES))
    for camera, raw in enumerate(raws):
        rows = np.flatnonzero(used & (flow.camera == camera))
        place = (flow.raw[rows, 1 - axis] * LINES / raw.size[1 - axis]).astype(np.intp)
        order = np.argsort(place, kind="stable")
        starts = np.flatnonzero(np.diff(place[order], prepend=-1))
        if len(rows):
            beyond[camera, place[order][starts]] = np.add.reduceat(products[rows[order]], starts)
        after[camera] = np.bincount(place, minlength=LINES)
    return beyond[:, ::-1].cumsum(axis=1)[:, ::-1], after[:, ::-1].cumsum(axis=1)[:, ::-1]


def _cost(parameters: int, flows: int) -> float:
    """Return the penalty of a break with so many parameters by so many flows of two components, and of the choice."""
    return 0.5 * parameters * math.log(2 * flows) + math.log(len(FORMS) * len(SETS) * LINES)


def _robust(A: Array, y: Array, x: Array) -> Array:
    """Return x (K,) that minimises the Geman-McClure cost of y - A x, A (N, 2, K), from a start."""
    size = A.shape[2]
    for _ in range(ROUNDS):
        weight = 1.0 / (1.0 + ((y - A @ x) ** 2).sum(axis=1) / KERNEL_WIDTH**2) ** 2
        weighted = (weight[:, None, None] * A).reshape(-1, size)
        H = weighted.T @ A.reshape(-1, size) + np.diag(_prior(size))
        x = np.linalg.solve(H, weighted.T @ y.ravel())
    return x


def _prior(size: int) -> Array:
    """Return the information (K,) that there is on parameters: of those of the null hypothesis, on the lag."""
    return np.where((np.arange(size) == LAG) & (size > LAG), 1.0, RIDGE)


def _is_same(one: Break, other: Break) -> bool:
    return one.kind == other.kind and one.cameras == other.cameras and one.kind == "torn"


def _words(breaks: list[Break], pairs: int) -> str:
    """Return what breaks of one kind in the same cameras were, and what to do."""
    newest = breaks[0]
    names = [CAMERAS[camera] for camera in newest.cameras]
    cameras = " and the ".join(names) + (" cameras" if len(names) > 1 else " camera")
    line, beyond, before = ("row", "below", "above") if newest.axis == 0 else ("column", "right of", "left of")
    low, middle, high = (round(px) for px in np.quantile([found.line_px for found in breaks], (0.2, 0.5, 0.8)))
    place = f"{line} {middle}" if high - low < STEADY_PX else f"{line}s {low} to {high}"
    shown = "1 pair shows" if pairs == 1 else f"{pairs} pairs show"
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
