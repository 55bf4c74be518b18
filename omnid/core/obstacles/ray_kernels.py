"""Compiled loops over rays: sums over the bins of a ray, and rays gathered by cells."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from omnid.core.compiled import compiled, inner

Floats = NDArray[np.float32]
Doubles = NDArray[np.float64]
Bytes = NDArray[np.uint8]


class RayParameters(NamedTuple):
    """The posterior of rays; log-likelihood ratios in nats."""

    # Rates of the prior, per metre of a ray.
    things_per_m: float = 0.1
    rare_per_m: float = 0.05  # of obstacles that hang, and of slopes
    steps_per_m: float = 0.005
    low_per_m: float = 0.02  # of low obstacles, over whose top the floor behind is seen
    ends_per_m: float = 2.0  # of the end of a low obstacle, along its top
    changes_per_m: float = 0.02  # of borders behind which the floor looks otherwise
    # Probabilities.
    similar: float = 0.1  # something looks like the floor
    no_end: float = 0.1  # the end of a low obstacle shows no surface
    invisible: float = 0.005  # the end of the floor beyond the last bin shows no foot
    nearer: float = 0.02  # something begins nearer than the view and looks like the floor; and otherwise
    marks: float = 0.02  # m: an edge in a bin of the floor, before any was seen
    marks_behind: float = 0.2  # an edge in a bin of what hides the floor,
    marks_plain: float = 0.01  # and of something plain
    plain_behind: float = 0.3  # what hides the floor has no texture
    tail: float = 0.05  # a step of the floor has 2.5 times its sigma
    # Noises and scales.
    contrast: float = 0.15  # b: of the difference of grey between an obstacle and the floor, by the floor's grey
    surface_noise: float = 0.4  # of the best surface where there is none [nats]
    noise_share: float = 0.4  # sigma of a step by noise alone, by the noise of a pixel of both views
    grey_share: float = 0.06  # least sigma of the floor's grey, by the grey,
    near_grey_share: float = 0.01  # and where it is known at that range
    # Temperatures, as neighbouring bins and directions are not independent.
    w_floor: float = 0.15
    w_edge: float = 0.5
    w_level: float = 0.3
    w_look: float = 0.2
    # Bounds of what one bin says [nats].
    floor_most: float = 10.0
    level_most: float = 4.0
    surface_most: float = 8.0
    look_low: float = -2.5
    look_high: float = 1.0
    cell_most: float = 4.0
    # Surfaces: the mean over so many directions counts as that of so many of them that have errors of their own. Steps
    # down are compared over this width [m]: what is narrower than a wheel's way is no edge, but a reflection below the
    # floor may be.
    wide_columns: float = 11.0
    wide_weight: float = 5.0
    edge_m: float = 0.2
    # Look of the floor: learned up to this range [m], from so many bins at least.
    look_m: float = 1.6
    look_bins: float = 60.0


PARAMETERS = RayParameters()
FLOOR, ABOVE, BELOW, LOOK, EDGE, BARE, BEGINS, FITS = range(8)  # terms of `posterior`
APART = 6  # bins from which a surface is another one, as one fits within two disparities around
LEAST_REACH = 0.01  # probability of a ray that it comes to a bin, below which it says nothing of it


# log(1 + exp(-x)) in steps of 1 / FINE from 0 on: a ray needs hundreds of sums of likelihoods by their logarithms.
FINE, MOST = 128.0, 30.0
SOFT = np.log1p(np.exp(-(np.arange(int(FINE * MOST) + 2) + 0.5) / FINE))


@inner
def log_sum(a: float, b: float) -> float:
    """Return log(exp(a) + exp(b)) within 0.002."""
    apart = a - b if a > b else b - a
    high = a if a > b else b
    return high + SOFT[int(apart * FINE)] if apart < MOST else high


@compiled(
    "(f4[:, :, ::1], f4[::1], f4[::1], f4[::1], f8, f4[:, ::1], f4[:, ::1], f4[:, ::1])",
    writes=("first", "ratios", "view"),
)
def posterior(
    terms: Floats,
    lengths_m: Floats,
    far_edges: Floats,
    near_surfaces: Floats,
    nearest_m: float,
    first: Floats,
    ratios: Floats,
    view: Floats,
) -> None:
    """Write the probability (D, N + 1) that a ray's first obstacle begins in a bin, last: nowhere; and for the grid
    (D, N) the log-ratio of each bin to its prior, and the probability that the ray comes there.

    terms (8, N, D): log-likelihood ratios to a hidden bin, of floor by stereo, less those of planes above and
    below, of the look of floor, of floor and of a plain obstacle by edges, of a beginning by its edge, and of surfaces.
    lengths_m (N,) of the bins; far_edges (D,): sigmas of the largest step beyond the last bin; near_surfaces (D,):
    log-likelihood ratios of the best surface nearer than the first; nearest_m: range of the nearest floor in view.
    """
    p = PARAMETERS
    bins, directions = terms.shape[1:]
    up, down, look, later = np.zeros(bins + 1), np.zeros(bins + 1), np.zeros(bins + 1), np.zeros(bins + 1)
    upright, steps, total = np.empty(bins), np.empty(bins), np.empty(bins)
    begins, top = np.empty(bins), np.empty(bins)
    # Logarithms of all that does not depend on the direction.
    log_length, log_stays, log_changes, prior_odds = np.log(lengths_m), np.empty(bins), np.empty(bins), np.empty(bins)
    for n in range(bins):
        change = min(p.changes_per_m * lengths_m[n], 0.1)
        log_stays[n], log_changes[n] = math.log1p(-change), math.log(change)
        prior = min((p.things_per_m + p.rare_per_m) * lengths_m[n], 0.5)
        prior_odds[n] = math.log(prior / (1.0 - prior))
    log_things, log_over = math.log(p.things_per_m), math.log(p.rare_per_m)
    log_steps, log_slopes = math.log(p.steps_per_m), math.log(p.rare_per_m)
    log_low, log_ends, log_top = math.log(p.low_per_m), np.empty(bins), np.empty(bins)
    log_no_end, log_end_shows = math.log(p.no_end), math.log1p(-p.no_end)
    for n in range(bins):
        end = min(p.ends_per_m * lengths_m[n], 0.5)
        log_ends[n], log_top[n] = math.log(end), math.log1p(-end)
    log_similar, log_other_look = math.log(p.similar), math.log1p(-p.similar)
    other_at_start = min(0.1 * p.changes_per_m * nearest_m, 0.5)
    log_known, log_other = math.log1p(-other_at_start), math.log(other_at_start)
    log_nearer, log_nearest, log_2 = math.log(p.nearer), math.log(nearest_m), math.log(2.0)
    for u in range(directions):
        # 1. Sums from each bin to the last: planes beside the floor, look, and obstacles behind the first one.
        plain = 0.0
        for n in range(bins - 1, -1, -1):
            plain += terms[BARE, n, u]
            look[n] = look[n + 1] + terms[LOOK, n, u]
            up[n], down[n] = up[n + 1] + terms[ABOVE, n, u], down[n + 1] + terms[BELOW, n, u]
            likely = math.exp(terms[FITS, n, u]) if terms[FITS, n, u] > 0.0 else 1.0
            later[n] = later[n + 1] + likely * p.things_per_m * lengths_m[n]
        # 2. What ends the floor beyond the last bin shows its foot, too.
        foot = math.log(p.invisible + (1.0 - p.invisible) / (1.0 + math.exp(-2.0 * (far_edges[u] - 4.0))))
        # 3. What begins in a bin, low or upright, given the floor before it.
        for n in range(bins):
            own = terms[EDGE, n - 1, u] if n else 0.0  # a step reaches into the bin before
            similar = log_sum(log_similar + min(max(look[n], -30.0), 30.0), log_other_look)
            begins[n] = terms[BEGINS, n, u] - own + log_length[n]
            upright[n] = begins[n] + similar + math.log1p(later[min(n + APART, bins)])
        # 4. From a bin on: floor that looks as known, or otherwise, up to what ends it; and the top of something low,
        #    which is seen up to where the floor goes on. Its end is a surface, up to a
        #    disparity nearer than that floor.
        known_on, other_on, top_on = foot - log_2, foot - log_2, -1e9
        for n in range(bins - 1, -1, -1):
            surface = max(terms[FITS, n, u], terms[FITS, max(n - 2, 0), u])
            end = log_ends[n] + log_sum(log_no_end, log_end_shows + surface if surface > 0.0 else -30.0)
            top_on = log_sum(top_on + log_top[n], log_sum(known_on, log_other + other_on) + end) + terms[ABOVE, n, u]
            top[n] = top_on
            ends = upright[n] + terms[FITS, n, u] + log_things
            floor = terms[FLOOR, n, u] + terms[EDGE, n, u]
            known_on += terms[LOOK, n, u]
            known_before = log_sum(log_stays[n] + known_on, log_changes[n] + other_on)
            other_on = log_sum(floor + log_sum(log_stays[n] + other_on, log_changes[n] + known_on), ends)
            known_on = log_sum(floor + known_before, ends)
        # 5. The classes of each bin; `before`: floor up to it, which looks as known, or otherwise: beyond a border of
        #    sun or of another covering.
        before, slope, as_known, other_look, looks = 0.0, -1e9, log_known, log_other, 0.0
        for n in range(bins):
            here = before + looks
            level = log_sum(down[n], up[n]) + log_steps
            steps[n] = here + log_sum(upright[n] + level, begins[n] + top[n] + log_low)
            upright[n] += here + terms[FITS, n, u] + log_things
            slope = log_sum(slope, before + looks + up[n] + look[n] + log_slopes + log_length[n])
            before += terms[FLOOR, n, u] + terms[EDGE, n, u]
            kept = log_sum(as_known + log_stays[n], other_look + log_changes[n]) + terms[LOOK, n, u]
            other_look = log_sum(other_look + log_stays[n], as_known + log_changes[n])
            as_known, looks = kept, log_sum(kept, other_look)
        none = log_sum(before + looks + foot - log_2, slope + foot)
        # 6. Nearer than the view: the look of floor may have been learned from it, or it has one of its own.
        #    What is plain shows fewer edges. It may show a surface.
        nearer = log_nearer + log_sum(look[0], log_sum(0.0, plain) - log_2)
        if near_surfaces[u] > 0.0:
            nearer = log_sum(nearer, near_surfaces[u] - p.surface_noise + log_things + log_nearest)
        # 7. Something that hangs over floor in view: all that may begin beyond.
        beyond = high = none
        for n in range(bins - 1, -1, -1):
            here = log_sum(upright[n], steps[n])
            hanging = beyond + terms[FITS, n, u] - p.surface_noise + log_over + log_length[n]
            total[n] = log_sum(here, hanging)
            beyond = log_sum(beyond, here)
            high = max(high, total[n])
        high = max(high, nearer)
        # 8. Normalised. What may be nearer hides the first bin, but is no evidence for its place.
        hidden = math.exp(nearer - high)
        last = math.exp(none - high)
        weight = last + hidden
        for n in range(bins):
            total[n] = math.exp(total[n] - high) if total[n] - high > -40.0 else 0.0
            weight += total[n]
        hidden /= weight
        reach = 1.0 - hidden
        for n in range(bins):
            found = total[n] / weight
            first[u, n] = found if n else found + hidden
            # 9. For the grid: log-ratio of an obstacle here, where the ray comes, to its prior.
            ratios[u, n], view[u, n] = 0.0, reach
            if reach > LEAST_REACH:
                rate = min(max(found / reach, 1e-6), 1.0 - 1e-6)
                ratio = (math.log(rate / (1.0 - rate)) - prior_odds[n]) * reach
                ratios[u, n] = min(max(ratio, -p.cell_most), p.cell_most)
            reach = max(reach - found, 0.0)
        first[u, bins] = last / weight


RATIO, VIEW, SURFACE = 0, 1, 2  # layers of what `gather` writes
UNSEEN, IN_VIEW, SEEN_PAST, HIDDEN, MOSTLY_PAST = 0, 1, 2, 3, 4  # states of a cell in a pair
CELL_M = 0.05  # of the grid
THIN_M = 0.035  # Width of the thinnest obstacle. With 0.03, by trial, more bases stood on polished floors.
MOST_BESIDE = 60  # directions of a cell on either side, that of one next to the viewpoint


@compiled(
    "(f4[:, ::1], f4[:, ::1], f4[:, ::1], u1[::1], f8[::1], f4[:, ::1], f4[:, ::1], f8, f4[:, :, ::1], u1[:, ::1])",
    writes=("cells", "states"),
)
def gather(
    ratios: Floats,
    view: Floats,
    surface: Floats,
    near: Bytes,
    ends: Doubles,
    ranges: Floats,
    at: Floats,
    reach_m: float,
    cells: Floats,
    states: Bytes,
) -> None:
    """Write the evidence (3, N, N) of cells, and their states (N, N).

    ratios, view, surface (D, K): of a RayBelief; near (D,): 1 where the nearest floor in view is seen, 2 where
    something hides it, 0 where nothing is in view; ends (K + 1,): ranges of the bins.
    ranges [m], at (N, N): ranges and directions of the cells, from the viewpoint, up to reach_m.
    A cell has the largest ratio of the bins and directions in it: a pole fills no cell.
    """
    directions, bins = ratios.shape
    by_angle, row = directions / math.tau, np.empty(2 * MOST_BESIDE + 2)
    for i in range(cells.shape[1]):
        for j in range(cells.shape[2]):
            cells[RATIO, i, j] = cells[VIEW, i, j] = cells[SURFACE, i, j] = 0.0
            states[i, j] = UNSEEN
            r = float(ranges[i, j])
            if r > reach_m or r < 0.5 * CELL_M:
                continue
            half = min(0.5 * CELL_M / r * by_angle, MOST_BESIDE)
            first, last = math.ceil(at[i, j] - half), math.floor(at[i, j] + half)
            if last < first:
                first = last = round(at[i, j])
            begin = np.searchsorted(ends, r - 0.5 * CELL_M) - 1
            end = np.searchsorted(ends, r + 0.5 * CELL_M) - 1
            if begin < 0:
                # Too near to be seen: known by what is seen past it.
                hidden, past = 0, 0
                for u in range(first, last + 1):
                    state = near[u % directions]
                    hidden += state == 2
                    past += state == 1
                # The thinnest obstacle there would hide so many directions.
                if hidden >= min(0.6 * THIN_M / r * by_angle, last - first + 1.0):
                    states[i, j] = HIDDEN
                elif past + hidden == last - first + 1:
                    states[i, j] = SEEN_PAST if hidden == 0 else MOSTLY_PAST
                continue
            if end >= bins:
                continue
            # A thin obstacle hides so many directions together: their mean counts, as one alone is noise.
            run = max(min(round(THIN_M / r * by_angle), last - first + 1), 1)
            most, least, total, together, seen = -99.0, 1.0, 0.0, 0.0, 0
            for u in range(first, last + 1):
                at_u, ratio, shown, is_seen = u % directions, 0.0, 0.0, False
                for k in range(begin, end + 1):
                    if view[at_u, k] > 0:
                        ratio = max(ratio, ratios[at_u, k]) if is_seen else ratios[at_u, k]
                        is_seen = True
                    shown = max(shown, surface[at_u, k])
                    least = min(least, view[at_u, k])
                seen += is_seen
                total += min(max(shown - 0.4, 0.0), 1.5)
                row[u - first] = ratio
                together += ratio
                if u - first >= run:
                    together -= row[u - first - run]
                if u - first >= run - 1:
                    most = max(most, together / run)
            if seen == 0:  # out of sight, as beside a sector
                continue
            cells[RATIO, i, j], cells[VIEW, i, j] = most, least
            cells[SURFACE, i, j] = total / (last - first + 1)
            states[i, j] = IN_VIEW
