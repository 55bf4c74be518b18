"""Compiled search for a way on the floor: wave front over cells, then A* over poses with arcs as moves.

Grids (N, N) are indexed by row (y) and column (x). Times are in seconds. Steps are those of `planner.py`.
"""

from __future__ import annotations

import heapq
import math

import numpy as np
from numpy.typing import NDArray

from omnid.core.compiled import compiled, inner

Doubles = NDArray[np.float64]

HEADINGS = 16  # of a full turn, in which poses count as different
MOST_NODES = 100_000  # poses that a search reaches at most, so that its time is bounded


@compiled("(f8[:, ::1], f8[:, ::1])", writes=("left_s",))
def wave_front(cell_s: Doubles, left_s: Doubles) -> None:
    """Lower the times left_s (N, N) to that of the fastest way to a cell whose time is known (Dijkstra 1959).

    cell_s (N, N): time across a cell, inf where the base cannot be. left_s: inf where nothing is known.
    """
    size = len(cell_s)
    queue = [(0.0, 0)]
    queue.pop()
    for row in range(size):
        for column in range(size):
            if left_s[row, column] < math.inf:
                heapq.heappush(queue, (left_s[row, column], row * size + column))
    while len(queue):
        at_s, cell = heapq.heappop(queue)
        row, column = cell // size, cell % size
        if at_s > left_s[row, column]:
            continue
        for step in range(9):
            r, c = row + step // 3 - 1, column + step % 3 - 1
            if not (0 <= r < size and 0 <= c < size):
                continue
            there_s = at_s + math.hypot(r - row, c - column) * cell_s[r, c]
            if there_s < left_s[r, c]:
                left_s[r, c] = there_s
                heapq.heappush(queue, (there_s, r * size + c))


@inner
def distance_at(
    distance_m: Doubles, movers: Doubles, cell_m: float, meeting_s: float, x: float, y: float, at_s: float
) -> float:
    """Return the distance [m] of a place [cells] to the nearest obstacle, at rest or moving, about a time [s].

    movers (K, 5): place, velocity and radius, in cells and seconds.
    """
    size = len(distance_m)
    away_m: float = distance_m[min(max(round(y), 0), size - 1), min(max(round(x), 0), size - 1)]
    for k in range(len(movers)):
        to_x, to_y = x - movers[k, 0], y - movers[k, 1]
        vx, vy = movers[k, 2], movers[k, 3]
        t = (to_x * vx + to_y * vy) / max(vx * vx + vy * vy, 1e-9)
        t = min(max(t, at_s - meeting_s, 0.0), at_s + meeting_s)
        away_m = min(away_m, cell_m * (math.hypot(to_x - t * vx, to_y - t * vy) - movers[k, 4]))
    return away_m


@compiled("(f8[:, ::1], f8[:, ::1], f8[:, ::1], f8[::1], f8[:, ::1], f8[:, ::1], f8[:, ::1], f8[::1])", writes=())
def search(
    distance_m: Doubles,
    cell_s: Doubles,
    left_s: Doubles,
    start: Doubles,
    moves: Doubles,
    discs: Doubles,
    movers: Doubles,
    limits: Doubles,
) -> Doubles:
    """Return the fastest way (K, 4) of x, y, heading and move from a pose to where no time is left, empty without one.

    distance_m: to the nearest obstacle at rest. cell_s: time across a cell. left_s: lower bound of the time left. start
    (3,): x, y in cells, heading. moves (M, 4): signed way in cells, turn [rad], least time [s], kind (0: ahead, 1:
    back, 2: turn). discs (3, D): centres ahead of the origin [cells] of the discs that cover what must be free in a
    move of each kind. movers: as in `distance_at`. limits: radius of the discs [m], time of a change of the kind [s],
    time left at which the goal is reached [s], heading at the end [rad] (NaN: any), kind of the move that cannot be the
    first one (-1: none), size of a cell [m], time by which moving objects may be early or late [s], time up to which
    they are predicted [s].
    """
    size = len(distance_m)
    radius_m, change_s, done_s, end_rad, barred, cell_m, meeting_s, horizon_s = limits
    nodes = np.empty((MOST_NODES, 4))  # x, y, heading, time
    from_node = np.empty(MOST_NODES, np.int64)
    by_move = np.empty(MOST_NODES, np.int64)
    best_s = np.full((size, size, HEADINGS), np.inf)
    nodes[0, :3] = start
    nodes[0, 3], from_node[0], by_move[0] = 0.0, -1, -1
    count = 1
    queue = [(left_s[round(start[1]), round(start[0])], 0)]
    while len(queue):
        _, node = heapq.heappop(queue)
        x, y, heading, at_s = nodes[node, 0], nodes[node, 1], nodes[node, 2], nodes[node, 3]
        row, column = round(y), round(x)
        if at_s > best_s[row, column, round(heading * HEADINGS / math.tau) % HEADINGS] + 1e-9:
            continue
        # 1. The end, from the last pose back to the first.
        off_rad = abs((heading - end_rad + math.pi) % math.tau - math.pi)
        if left_s[row, column] <= done_s and not off_rad > math.tau / HEADINGS:
            length, at = 0, node
            while at >= 0:
                length, at = length + 1, from_node[at]
            way = np.empty((length, 4))
            while length > 0:
                length -= 1
                way[length, :3] = nodes[node, :3]
                way[length, 3] = by_move[node]
                node = from_node[node]
            return way
        # 2. All moves from here.
        for k in range(len(moves)):
            along, turn, least_s, kind = moves[k]
            if node == 0 and kind == barred:
                continue
            middle = heading + 0.5 * turn
            to_x, to_y, to_heading = x + along * math.cos(middle), y + along * math.sin(middle), heading + turn
            r, c = round(to_y), round(to_x)
            if not (0 <= r < size and 0 <= c < size) or not left_s[r, c] < math.inf:
                continue
            there_s = at_s + max(least_s, abs(along) * cell_s[r, c])
            if node > 0 and moves[by_move[node], 3] != kind:
                there_s += change_s
            there_bin = round(to_heading * HEADINGS / math.tau) % HEADINGS
            if there_s >= best_s[r, c, there_bin] - 1e-9 or count == MOST_NODES:
                continue
            # 3. The distance of obstacles there; a base that begins too near to one may get no nearer.
            is_free = True
            for disc in discs[int(kind)]:
                there = distance_at(
                    distance_m,
                    movers,
                    cell_m,
                    meeting_s,
                    to_x + disc * math.cos(to_heading),
                    to_y + disc * math.sin(to_heading),
                    min(there_s, horizon_s),
                )
                if there < radius_m:
                    here_x, here_y = x + disc * math.cos(heading), y + disc * math.sin(heading)
                    here = distance_at(distance_m, movers, cell_m, meeting_s, here_x, here_y, min(at_s, horizon_s))
                    is_free = is_free and here < radius_m and there >= here
            if is_free:
                best_s[r, c, there_bin] = there_s
                nodes[count, 0], nodes[count, 1] = to_x, to_y
                nodes[count, 2], nodes[count, 3] = to_heading, there_s
                from_node[count], by_move[count] = node, k
                heapq.heappush(queue, (there_s + left_s[r, c], count))
                count += 1
    return np.empty((0, 4))
