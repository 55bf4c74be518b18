"""Ramps: a second plane of the floor, which begins at a line across the way.

A ramp of slope s that begins x_0 ahead lies on a plane of its own: z = -(h + s x_0) + r (a + s) cos(u), about the
viewpoint, over a floor z = -h + r a cos(u). So it has a disparity in each row, too, and both planes are compared, pixel
by pixel, in the rows beyond the line. Of all (x_0, s) the likeliest is taken, where it explains those rows better than
the floor, and than anything upright, in most directions: what is narrower than the way, such as a box, is no ramp, and
neither is a wall.
A ramp goes up by at most what may be driven; and down by at most what the base has climbed: a landing. Any other fall
is an edge.
"""

from __future__ import annotations

import math
from typing import Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from omnid.core.compiled import compiled
from omnid.core.obstacles.evidence_kernels import OUTLIER, UNITS
from omnid.core.obstacles.plane_view import AZIMUTHS, BOUNDED_SIGMAS, FOCAL_PX, FloorPlane, PlaneView, WorkingPair

Array = NDArray[np.float64]
Bytes = NDArray[np.uint8]
Floats = NDArray[np.float32]
Numbers = NDArray[np.int32]
Flags = NDArray[np.bool_]

STEEPEST: Final = math.tan(math.radians(10.0))  # ramp that may be driven,
TOO_STEEP: Final = np.tan(np.radians(np.arange(12.0, 21.0, 2.0)))  # and others, for which it must not be taken
GENTLEST: Final = math.tan(math.radians(1.0))  # The filter of the tilt follows what is less.
STEP: Final = math.tan(math.radians(0.5))  # between slopes that are compared
STARTS_M: Final = np.arange(0.6, 3.3, 0.1)  # where ramps are looked for: nearer ones are known by their pairs before
SEEN_M: Final = 4.0  # range up to which they are seen
HALF_RAD: Final = math.radians(27.0)  # half of the angle in which a ramp is as wide as the way
PARTS: Final = 8  # of that angle: most of them must show a ramp
# Log-likelihood by a sigma of difference of a pixel: that of evidence_kernels.py with its weight in the posterior.
RATIO: Final = 0.075
LEAST_NATS: Final = 10.0  # Evidence of a ramp in one pair: without one it is below 4 in textured corridors.
SAME_M, SAME = 0.5, math.tan(math.radians(3.0))  # within which pairs show the same ramp
VIEWS: Final = 3.0  # Pairs that count: nearer ones show a ramp better.


class Ramp(NamedTuple):
    """The floor beyond a line across a way, about the viewpoint of a pair."""

    start_m: float  # of the line, along the way; below 0: behind
    slope: float  # along the way, against the floor before the line
    way_rad: float  # azimuth of the way in the rectified frame

    def plane(self, floor: FloorPlane) -> FloorPlane:
        """Return the plane of the ramp, which begins on a floor."""
        a, b = floor.a + self.slope * math.cos(self.way_rad), floor.b + self.slope * math.sin(self.way_rad)
        return FloorPlane(floor.height_m + self.slope * self.start_m, a, b)

    def begins_before(self, ranges_m: Array) -> Flags:
        """Return whether places at ranges (N,) are beyond the line (N, DIRECTIONS)."""
        return np.asarray(np.outer(ranges_m, np.cos(AZIMUTHS - self.way_rad)) > self.start_m)


@compiled(
    "(u1[:, ::1], u1[:, ::1], u1[:, ::1], f4[::1], i4[:, ::1], f8[::1], f8, f8, f8, f8, f8, f8[::1], f8[::1], u1,"
    " f8[:, :, ::1], f8[:, :, ::1])",
    writes=("ramps", "upright"),
)
def gains(
    lower: Bytes,
    upper: Bytes,
    live: Bytes,
    plane_rows: Floats,
    parts: Numbers,
    along: Array,
    row0: float,
    focal_px: float,
    height_m: float,
    baseline_m: float,
    seen_m: float,
    starts_m: Array,
    slopes: Array,
    outlier: np.uint8,
    ramps: Array,
    upright: Array,
) -> None:
    """Write by how much the rows of parts of the way differ less on ramps, and on what is upright, than on the floor.

    lower, upper, live (H, W): normalised panoramas, and 255 where pixels may be compared; plane_rows (H,): row of the
    upper one that shows the floor of a row, row0: the horizon. parts (P, C): directions, along (W,): cosines of all
    against the way. starts_m (X,), slopes (S,) of ramps, seen up to the range seen_m. ramps (P, X, S). upright
    (P, K, H): by disparity, in each row above its foot.
    """
    height = len(lower)
    for p in range(len(parts)):
        ramps[p], upright[p] = 0.0, 0.0
        for u in parts[p]:
            for v in range(int(row0) + 1, height):
                on_floor = plane_rows[v]
                if live[v, u] == 0 or on_floor > height - 2:
                    continue
                fall, mine, most = v - row0, float(lower[v, u]), float(outlier)
                above = int(on_floor)
                share = on_floor - above
                floor = min(abs(mine - (1.0 - share) * upper[above, u] - share * upper[above + 1, u]), most)
                for k in range(math.ceil(baseline_m / height_m * fall), min(upright.shape[1], height - v)):
                    upright[p, k, v] += floor - min(abs(mine - upper[v + k, u]), most)
                for x in range(len(starts_m)):
                    # Before the start the floor is what it was.
                    if fall * starts_m[x] > focal_px * height_m * along[u]:
                        break
                    for s in range(len(slopes)):
                        lift = fall + focal_px * slopes[s] * along[u]
                        below_m = height_m + slopes[s] * starts_m[x]
                        if lift * seen_m < focal_px * below_m or lift <= 0.0:
                            continue
                        row = v + baseline_m * lift / below_m
                        above = int(row)
                        if above > height - 2:
                            continue
                        share = row - above
                        shown = (1.0 - share) * upper[above, u] + share * upper[above + 1, u]
                        ramps[p, x, s] += floor - min(abs(mine - shown), most)


class Ramps:
    """The ramp before a base, or that which it drives onto, by all pairs."""

    def __init__(self) -> None:
        self.way_rad, self.offset_m = 0.0, 0.0  # azimuth of the way in odom, and offset of the line along it
        self._slope, self._nats = 0.0, 0.0  # and evidence by all pairs; 0: no ramp is known

    def forget(self) -> None:
        """Forget the ramp that is known."""
        self._nats = 0.0

    def seen_from(self, viewpoint: Array, turn_rad: float) -> Ramp | None:
        """Return the ramp that is known, from a viewpoint (x, y, heading) in odom; turn_rad: of odom in the rectified
        frame."""
        if not self._nats:
            return None
        return Ramp(self.offset_m - self._along(viewpoint, self.way_rad), self._slope, self.way_rad + turn_rad)

    def search(self, pair: WorkingPair, view: PlaneView, viewpoint: Array, turn_rad: float, climbed: float) -> bool:
        """Search for a ramp ahead in a pair on the floor before it; return whether it is a new one.

        viewpoint: x, y, heading in odom; turn_rad: of odom in the rectified frame; climbed: slope of the base in odom.
        """
        # 1. Gains of all ramps in parts of the way.
        aside = np.angle(np.exp(1j * (AZIMUTHS - viewpoint[2] - turn_rad)))
        order = np.argsort(aside)
        ahead = order[np.abs(aside[order]) < HALF_RAD]
        parts = ahead[: len(ahead) // PARTS * PARTS].reshape(PARTS, -1)[:, ::2].astype(np.int32)
        slopes = np.append(np.arange(GENTLEST, STEEPEST + STEP / 2, STEP), TOO_STEEP)
        if climbed > GENTLEST:  # A landing is level.
            slopes = np.append(slopes, STEP * np.arange(-2, 3) - climbed)
        ramps = np.empty((PARTS, len(STARTS_M), len(slopes)))
        upright = np.empty((PARTS, math.ceil(view.at_1m / STARTS_M[0]), view.height))
        live, height_m = pair.seen * np.uint8(255), view.plane.height_m
        images = *pair.normalised(BOUNDED_SIGMAS), live, view.plane_rows, np.ascontiguousarray(parts), np.cos(aside)
        geometry = view.row0, FOCAL_PX, height_m, view.at_1m / FOCAL_PX, SEEN_M
        gains(*images, *geometry, STARTS_M, slopes, OUTLIER, ramps, upright)
        # 2. Those of the best upright thing in the same rows of each part, from the farthest of a ramp to its start.
        sums = np.pad(np.cumsum(upright, axis=2), ((0, 0), (0, 0), (1, 0)))
        below_m = height_m + np.outer(STARTS_M, slopes)
        far = np.ceil(view.row0 + FOCAL_PX * (below_m / SEEN_M - slopes)).astype(int)
        near = np.floor(view.row0 + FOCAL_PX * height_m / STARTS_M).astype(int)[:, None]
        ends = (np.clip(rows, int(view.row0), view.height) for rows in (near + 1, far))
        things = np.subtract(*(sums[:, :, rows] for rows in ends)).max(axis=1)
        # 3. The likeliest, which most parts show. Every second direction was looked at.
        nats = 2 * RATIO / UNITS * PARTS * np.median(ramps - np.maximum(things, 0), axis=0)
        x, s = np.unravel_index(nats.argmax(), nats.shape)
        if nats[x, s] < LEAST_NATS or slopes[s] >= TOO_STEEP[0]:
            return False
        offset_m = float(STARTS_M[x]) + self._along(viewpoint, viewpoint[2])
        return self._add(float(viewpoint[2]), offset_m, float(slopes[s]), float(nats[x, s]))

    def _add(self, way_rad: float, offset_m: float, slope: float, nats: float) -> bool:
        """Take what a pair shows into the mean of those that showed the same ramp, weighted by their evidence; return
        whether it is a new one."""
        is_same = abs(offset_m - self.offset_m) < SAME_M and abs(slope - self._slope) < SAME
        if not self._nats or not is_same or math.cos(way_rad - self.way_rad) < math.cos(HALF_RAD):
            self.way_rad, self.offset_m, self._slope, self._nats = way_rad, offset_m, slope, nats
            return True
        self._nats = min(self._nats, (VIEWS - 1) * nats) + nats
        share = nats / self._nats
        self.offset_m += share * (offset_m - self.offset_m)
        self._slope += share * (slope - self._slope)
        return False

    @staticmethod
    def _along(place: Array, way_rad: float) -> float:
        """Return how far a place is along a way in odom [m]."""
        return float(place[0] * math.cos(way_rad) + place[1] * math.sin(way_rad))
