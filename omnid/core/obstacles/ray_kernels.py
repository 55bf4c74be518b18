"""Compiled loops of the ray posterior: steps of grey along columns, log-likelihoods of bins, sums over a ray.

Bins are half a disparity wide. Arrays (D, N) hold D directions and N bins, from near to far; equations and the numbers
of the steps are those of posterior.py. Loops over bins of one direction are innermost, as all sums run along a ray.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from omnid.core.compiled import compiled, inner

Floats = NDArray[np.float32]
Doubles = NDArray[np.float64]
Bytes = NDArray[np.uint8]

# Names of posterior.RayParameters in the order in which the kernel is given their values, and their places there.
PARAMETERS = (
    "things_per_m",
    "hanging_per_m",
    "steps_per_m",
    "slopes_per_m",
    "contrast",
    "marks_behind",
    "alike",
    "invisible",
    "nearer",
    "surface_noise",
    "w_floor",
    "w_edge",
    "w_level",
    "tail",
    "floor_low",
    "floor_high",
    "surface_most",
    "level_most",
    "cell_low",
    "cell_high",
    "changes_per_m",
    "plain_behind",
    "marks_plain",
    "nearer_other",
)
THINGS, OVER, STEPS, SLOPES, CONTRAST, MARKS_BEHIND, ALIKE, INVISIBLE, NEARER, SURFACE_NOISE = range(10)
W_FLOOR, W_EDGE, W_LEVEL, TAIL, FLOOR_LOW, FLOOR_HIGH, SURFACE_MOST, LEVEL_MOST = range(10, 18)
CELL_LOW, CELL_HIGH, CHANGES, PLAIN_BEHIND, MARKS_PLAIN, NEARER_OTHER = range(18, 24)
# Bins of classes in `posterior`, so that a thing is told by how it was found.
UPRIGHT, HANGING, DOWN, UP = 0, 1, 2, 3
APART = 6  # bins from which a surface is another one, as one fits within two disparities around


# log(1 + exp(-x)) in steps of 1 / FINE from 0 on: a ray needs hundreds of sums of likelihoods by their logarithms.
FINE, MOST = 128.0, 30.0
SOFT = np.log1p(np.exp(-(np.arange(int(FINE * MOST) + 2) + 0.5) / FINE))
ROOT, LOG_2 = math.log(2.5066283), math.log(2.0)


@inner
def log_sum(a: float, b: float) -> float:
    """Return log(exp(a) + exp(b)) within 0.002."""
    apart = a - b if a > b else b - a
    high = a if a > b else b
    return high + SOFT[int(apart * FINE)] if apart < MOST else high


@inner
def log_noise(z: float, sigma_log: float, tail: float) -> float:
    """Return the log density of a step of z sigmas within one material: normal, a share with 2.5 times the sigma."""
    z2 = z * z
    return log_sum(math.log1p(-tail) - 0.5 * z2, math.log(0.4 * tail) - 0.08 * z2) - sigma_log - ROOT


@inner
def mean_between(sums: Floats, u: int, first: float, end: float) -> float:
    """Return the mean grey of a column between two rows, which may be fractions; sums (H + 1, D) from above."""
    last = sums.shape[0] - 1.0
    first = min(max(first, 0.0), last - 1e-3)
    end = min(max(end, 0.0), last - 1e-3)
    i, j = int(first), int(end)
    a = sums[i, u] + (first - i) * (sums[i + 1, u] - sums[i, u])
    b = sums[j, u] + (end - j) * (sums[j + 1, u] - sums[j, u])
    return float((b - a) / max(end - first, 1e-6))


@compiled("(f4[:, ::1], f4[:, ::1], f4[::1], f4[::1], f4[:, ::1], f4[:, ::1])", writes=("steps", "greys"))
def grey_steps(lower: Floats, upper: Floats, rows: Floats, shifts: Floats, steps: Floats, greys: Floats) -> None:
    """Write the steps of grey (N, D) across bins of the floor, and its grey there; means of both views.

    lower, upper (H, D): panoramas; rows, shifts (N,): row of a bin in the lower one, and by how many it is lower in the
    upper one. A step is the difference of the means of 2.6 rows on either side, less the trend of the rows beyond: a
    shading is no edge.
    """
    height, width = lower.shape
    sums = np.zeros((2, height + 1, width), np.float32)
    for v in range(height):
        for u in range(width):
            sums[0, v + 1, u] = sums[0, v, u] + lower[v, u]
            sums[1, v + 1, u] = sums[1, v, u] + upper[v, u]
    for n in range(len(rows)):
        for u in range(width):
            step, grey = 0.0, 0.0
            for view in range(2):
                at = rows[n] + (shifts[n] if view else 0.0)
                above, below = (
                    mean_between(sums[view], u, at - 3.6, at - 1.0),
                    mean_between(sums[view], u, at + 1.0, at + 3.6),
                )
                before, beyond = (
                    mean_between(sums[view], u, at - 8.0, at - 3.6),
                    mean_between(sums[view], u, at + 3.6, at + 8.0),
                )
                step += 0.5 * (above - below - 0.575 * (before - above + below - beyond))
                grey += 0.5 * mean_between(sums[view], u, at - 1.1, at + 1.1)
            steps[n, u], greys[n, u] = step, grey


@compiled(
    "(f4[:, ::1], f4[:, ::1], f4[:, ::1], f4[:, ::1], f4[:, ::1], f4[:, ::1], f4[:, ::1], u1[:, ::1],"
    " f4[::1], f4[::1], f4[::1], f8, f8, f8, f8[::1], f4[:, ::1], f4[:, :, ::1])",
    writes=("first", "cells"),
)
def posterior(
    floor: Floats,
    surface: Floats,
    above: Floats,
    below: Floats,
    steps: Floats,
    greys: Floats,
    appearance: Floats,
    seen: Bytes,
    sigmas: Floats,
    lengths_m: Floats,
    far_edges: Floats,
    marks: float,
    nearest_m: float,
    plain_sigma: float,
    p: Doubles,
    first: Floats,
    cells: Floats,
) -> None:
    """Write the probability (D, N + 1) that the first thing of a ray begins in a bin, last: nowhere; and for the grid
    (2, D, N): log-ratio of each bin to its prior, and the probability that its floor is in view.

    All arrays (D, N): log-likelihood ratios of floor, surfaces, planes above and below; steps of grey and greys; and
    the appearance of floor; seen: 1 where pixels are in view. sigmas (N,): of steps of the floor; lengths_m (N,) of the
    bins; far_edges (D,): sigmas of the largest step beyond the last bin; marks: of the floor, in a bin;
    nearest_m: range of the nearest floor in view;
    plain_sigma: of steps without any texture, by noise.
    """
    directions, bins = floor.shape
    even, edge, fits, begins = np.empty(bins), np.empty(bins), np.empty(bins), np.empty(bins)
    up, down, look, later = np.empty(bins + 1), np.empty(bins + 1), np.empty(bins + 1), np.empty(bins + 1)
    bare, plain = np.empty(bins), np.empty(bins + 1)
    of_class, total, beyond = np.empty((4, bins)), np.empty(bins), np.empty(bins + 1)
    # Logarithms of all that does not depend on the direction.
    log_length, log_sigma, stays, changes = np.log(lengths_m), np.log(sigmas), np.empty(bins), np.empty(bins)
    prior_odds = np.empty(bins)
    for n in range(bins):
        change = min(p[CHANGES] * lengths_m[n], 0.1)
        stays[n], changes[n] = math.log1p(-change), math.log(change)
        prior = min((p[THINGS] + p[OVER]) * lengths_m[n], 0.5)
        prior_odds[n] = math.log(prior / (1.0 - prior))
    log_things, log_over = math.log(p[THINGS]), math.log(p[OVER])
    log_steps, log_slopes = math.log(p[STEPS]), math.log(p[SLOPES])
    log_alike, log_unlike = math.log(p[ALIKE]), math.log1p(-p[ALIKE])
    log_mark, log_plain = math.log(marks), math.log1p(-marks)
    log_mark_behind, log_plain_behind = math.log(p[MARKS_BEHIND]), math.log1p(-p[MARKS_BEHIND])
    log_textured, log_even = math.log1p(-p[PLAIN_BEHIND]), math.log(p[PLAIN_BEHIND])
    log_plain_sigma = math.log(plain_sigma)
    log_mark_bare, log_plain_bare = math.log(p[MARKS_PLAIN]), math.log1p(-p[MARKS_PLAIN])
    other_at_start = min(0.1 * p[CHANGES] * nearest_m, 0.5)
    log_known, log_other = math.log1p(-other_at_start), math.log(other_at_start)
    log_nearer = math.log(p[NEARER_OTHER])
    log_alike_nearer = math.log(p[NEARER])
    for u in range(directions):
        # 1. Each bin: floor, and what begins there, by what is hidden.
        for n in range(bins):
            even[n] = edge[n] = begins[n] = bare[n] = 0.0
            if seen[u, n]:
                value = floor[u, n]
                value = 0.0 if math.isnan(value) else value
                even[n] = p[W_FLOOR] * min(max(value, p[FLOOR_LOW]), p[FLOOR_HIGH])
                scale, step = p[CONTRAST] * max(greys[u, n], 20.0), abs(steps[u, n])
                log_scale = math.log(2.0 * scale)
                other = -step / scale - log_scale
                core = log_noise(step / sigmas[n], log_sigma[n], p[TAIL])
                even_core = log_noise(step / plain_sigma, log_plain_sigma, p[TAIL])
                behind = log_sum(log_textured + core, log_even + even_core)
                begins[n] = other - log_sum(log_plain_behind + behind, log_mark_behind + other)
                # Windows of neighbouring bins overlap: an edge is one event, where it is largest.
                most = 0.0
                for near in range(max(n - 2, 0), min(n + 3, bins)):
                    most = max(most, abs(steps[u, near]))
                if step < most and step > 2.0 * sigmas[n]:
                    other = -2.0 * sigmas[n] / scale - log_scale
                    core = log_noise(2.0, log_sigma[n], p[TAIL])
                    behind = log_textured + core
                of_floor = log_sum(log_plain + core, log_mark + other)
                of_behind = log_sum(log_plain_behind + behind, log_mark_behind + other)
                edge[n] = p[W_EDGE] * (of_floor - of_behind)
                bare[n] = p[W_EDGE] * (log_sum(log_plain_bare + behind, log_mark_bare + other) - of_behind)
            fits[n] = min(surface[u, n], p[SURFACE_MOST]) - p[SURFACE_NOISE]
        # 2. Sums from each bin to the last: planes beside the floor, appearance, and things behind the first one.
        up[bins] = down[bins] = look[bins] = later[bins] = plain[bins] = 0.0
        for n in range(bins - 1, -1, -1):
            limit = p[LEVEL_MOST]
            plain[n] = plain[n + 1] + bare[n]
            look[n] = look[n + 1] + (appearance[u, n] if seen[u, n] else 0.0)
            up[n] = up[n + 1] + even[n] - p[W_LEVEL] * min(max(above[u, n], -limit), limit)
            down[n] = down[n + 1] + even[n] - p[W_LEVEL] * min(max(below[u, n], -limit), limit)
            likely = math.exp(fits[n]) if fits[n] > 0.0 else 1.0
            later[n] = later[n + 1] + likely * p[THINGS] * lengths_m[n]
        # 3. What ends the floor beyond the last bin shows its foot, too.
        foot = math.log(p[INVISIBLE] + (1.0 - p[INVISIBLE]) / (1.0 + math.exp(-2.0 * (far_edges[u] - 4.0))))
        # 4. The classes of each bin; `before`: floor up to it.
        # The floor looks as known, or otherwise: beyond a border of sun or of another covering.
        before, slope, as_known, looks = 0.0, -1e9, log_known, 0.0
        other_look = log_other
        for n in range(bins):
            own = edge[n - 1] if n else 0.0  # a step reaches into the bin before
            alike = log_sum(log_alike + min(max(look[n], -30.0), 30.0), log_unlike)
            here = before + looks - own + begins[n] + alike + math.log1p(later[min(n + APART, bins)])
            of_class[UPRIGHT, n] = here + fits[n] + log_things + log_length[n]
            step_prior = log_steps + log_length[n]
            of_class[DOWN, n], of_class[UP, n] = here + down[n] + step_prior, here + up[n] + step_prior
            slope = log_sum(slope, before + looks + up[n] + look[n] + log_slopes + log_length[n])
            before += even[n] + edge[n]
            kept = log_sum(as_known + stays[n], other_look + changes[n]) + (appearance[u, n] if seen[u, n] else 0.0)
            other_look = log_sum(other_look + stays[n], as_known + changes[n])
            as_known, looks = kept, log_sum(kept, other_look)
        before += looks
        none = log_sum(before + foot - LOG_2, slope + foot)
        # Nearer than the view: the look of floor may have been learned from it, or it has one of its own.
        # What is plain shows fewer edges.
        nearer = log_sum(look[0] + log_alike_nearer, log_nearer + log_sum(0.0, plain[0]) - LOG_2)
        # 5. Something that hangs over floor in view: all that may begin beyond.
        beyond[bins] = none
        for n in range(bins - 1, -1, -1):
            step = log_sum(of_class[DOWN, n], of_class[UP, n])
            beyond[n] = log_sum(beyond[n + 1], log_sum(of_class[UPRIGHT, n], step))
            of_class[HANGING, n] = beyond[n + 1] + fits[n] - p[SURFACE_NOISE] + log_over + log_length[n]
            total[n] = log_sum(log_sum(of_class[UPRIGHT, n], step), of_class[HANGING, n])
        total[0] = log_sum(total[0], nearer)
        # 6. Normalised.
        high = none
        for n in range(bins):
            high = max(high, total[n])
        last = math.exp(none - high)
        weight = last
        for n in range(bins):
            total[n] = math.exp(total[n] - high) if total[n] - high > -40.0 else 0.0
            weight += total[n]
        reach = 1.0
        for n in range(bins):
            found = total[n] / weight
            first[u, n] = found
            # 7. For the grid: log-ratio of a thing here, where the ray comes, to its prior.
            cells[0, u, n] = 0.0
            if reach > 0.01:
                rate = min(max(found / reach, 1e-6), 1.0 - 1e-6)
                ratio = (math.log(rate / (1.0 - rate)) - prior_odds[n]) * reach
                cells[0, u, n] = min(max(ratio, p[CELL_LOW]), p[CELL_HIGH])
            cells[1, u, n] = reach if seen[u, n] else 0.0
            reach = max(reach - found, 0.0)
        first[u, bins] = last / weight
