"""Compiled search for a way on the floor: wave front over cells, then A* over poses with arcs as moves.

Grids (N, N) are indexed by row (y) and column (x). Times are in seconds. Steps are those of `planner.py`.
"""

from __future__ import annotations

import heapq
import math

import numpy as np
from numpy.typing import NDArray

from omnid.core.compiled import compiled

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


@compiled("(f8[:, ::1], f8[:, ::1], f8[:, ::1], f8[::1], f8[:, ::1], f8[:, ::1], f8[::1])", writes=())
def search(
    room_m: Doubles,
    cell_s: Doubles,
    left_s: Doubles,
    start: Doubles,
    moves: Doubles,
    discs_m: Doubles,
    limits: Doubles,
) -> Doubles:
    """Return the fastest way (K, 4) of x, y, heading and move from a pose to where no time is left, empty without one.

    room_m: distance to the nearest obstacle. cell_s: time across a cell. left_s: lower bound of the time left.
    start (3,): x, y in cells, heading. moves (M, 4): signed way in cells, turn [rad], least time [s], kind (0: ahead,
    1: back, 2: turn). discs_m (3, D): centres ahead of the origin [cells] of the discs that cover what must be free in
    a move of each kind. limits: radius of the discs [m], time of a change of the kind [s], time left that counts as
    none [s], heading at the end [rad], NaN for any, kind of the move that cannot be the first one, -1 for none.
    """
    size = len(room_m)
    radius_m, change_s, done_s, end_rad, barred = limits
    nodes = np.empty((MOST_NODES, 3))
    from_node = np.empty(MOST_NODES, np.int64)
    by_move = np.empty(MOST_NODES, np.int64)
    best_s = np.full((size, size, HEADINGS), np.inf)
    nodes[0], from_node[0], by_move[0] = start, -1, -1
    count = 1
    queue = [(left_s[round(start[1]), round(start[0])], 0.0, 0)]
    while len(queue):
        _, at_s, node = heapq.heappop(queue)
        x, y, heading = nodes[node]
        row, column = round(y), round(x)
        bin = round(heading * HEADINGS / math.tau) % HEADINGS
        if at_s > best_s[row, column, bin] + 1e-9:
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
                way[length, :3] = nodes[node]
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
            # 3. The room of the base there; where it begins too near to something, it may get no nearer.
            is_free = True
            for disc in discs_m[int(kind)]:
                i = min(max(round(to_y + disc * math.sin(to_heading)), 0), size - 1)
                j = min(max(round(to_x + disc * math.cos(to_heading)), 0), size - 1)
                if room_m[i, j] < radius_m:
                    before_i = min(max(round(y + disc * math.sin(heading)), 0), size - 1)
                    before_j = min(max(round(x + disc * math.cos(heading)), 0), size - 1)
                    is_free = (
                        is_free and room_m[before_i, before_j] < radius_m and room_m[i, j] >= room_m[before_i, before_j]
                    )
            if not is_free:
                continue
            cost_s = max(least_s, abs(along) * cell_s[r, c])
            if node > 0 and moves[by_move[node], 3] != kind:
                cost_s += change_s
            there_s = at_s + cost_s
            there_bin = round(to_heading * HEADINGS / math.tau) % HEADINGS
            if there_s < best_s[r, c, there_bin] - 1e-9 and count < MOST_NODES:
                best_s[r, c, there_bin] = there_s
                nodes[count, 0], nodes[count, 1], nodes[count, 2] = to_x, to_y, to_heading
                from_node[count], by_move[count] = node, k
                heapq.heappush(queue, (there_s + left_s[r, c], there_s, count))
                count += 1
    return np.empty((0, 4))
