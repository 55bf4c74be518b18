"""Compiled search for a way on the floor: wave front over cells, then A* over poses with arcs as moves.

Grids (N, N) are indexed by row (y) and column (x). Lengths are in cells, times in seconds. Steps are those of
`planner.py`.
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
HORIZON_S = 4.0  # of a prediction of what moves; then it stays
MEETING_S = 0.6  # by which the base and what moves may be early or late


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
        for r in range(max(row - 1, 0), min(row + 2, size)):
            for c in range(max(column - 1, 0), min(column + 2, size)):
                there_s = at_s + math.hypot(r - row, c - column) * cell_s[r, c]
                if there_s < left_s[r, c]:
                    left_s[r, c] = there_s
                    heapq.heappush(queue, (there_s, r * size + c))


@inner
def room_at(room: Doubles, movers: Doubles, x: float, y: float, at_s: float) -> float:
    """Return the distance of a place from what does not move, and from what moves about a time.

    movers (K, 5): place, velocity and radius.
    """
    size = len(room)
    away: float = room[min(max(round(y), 0), size - 1), min(max(round(x), 0), size - 1)]
    for k in range(len(movers)):
        to_x, to_y = x - movers[k, 0], y - movers[k, 1]
        vx, vy = movers[k, 2], movers[k, 3]
        t = (to_x * vx + to_y * vy) / max(vx * vx + vy * vy, 1e-9)
        early_s = min(at_s, HORIZON_S) - MEETING_S
        t = min(max(t, early_s, 0.0), early_s + 2 * MEETING_S)
        away = min(away, math.hypot(to_x - t * vx, to_y - t * vy) - movers[k, 4])
    return away


@compiled("(f8[:, ::1], f8[:, ::1], f8[:, ::1])", writes=())
def rooms_along(room: Doubles, movers: Doubles, way: Doubles) -> Doubles:
    """Return `room_at` (N,) along a way (N, 3) of x, y and time."""
    rooms = np.empty(len(way))
    for k in range(len(way)):
        rooms[k] = room_at(room, movers, way[k, 0], way[k, 1], way[k, 2])
    return rooms


@compiled(
    "(f8[:, ::1], f8[:, ::1], f8[:, ::1], f8[::1], f8[:, ::1], f8[:, ::1], f8[:, ::1], f8, f8, f8, f8)", writes=()
)
def search(
    room: Doubles,
    cell_s: Doubles,
    left_s: Doubles,
    start: Doubles,
    moves: Doubles,
    discs: Doubles,
    movers: Doubles,
    radius: float,
    change_s: float,
    done_s: float,
    end_rad: float,
) -> Doubles:
    """Return the fastest way (K, 6) from a pose to where no time is left, empty without one. Last column: its moves.

    room: distance to what is nearest. cell_s: time across a cell. left_s: lower bound of the time left.
    start (3,): x, y, heading. moves (M, 3): signed way, turn [rad], least time. discs (3, D): centres ahead of the
    origin of the discs that cover what must be free in a move ahead, back, and on the spot. movers: as in `room_at`.
    radius: of the discs. change_s: time of a change between these. done_s: time left that counts as none. end_rad:
    heading at the end, NaN for any.
    """
    size = len(room)
    nodes = np.empty((MOST_NODES, 6))  # x, y, heading, time, node before, move from there
    best_s = np.full((size, size, HEADINGS), np.inf)
    nodes[0, :3], nodes[0, 3:] = start, (0.0, -1.0, -1.0)
    count = 1
    queue = [(left_s[round(start[1]), round(start[0])], 0)]
    while len(queue):
        _, node = heapq.heappop(queue)
        x, y, heading, at_s, _, move = nodes[node]
        row, column = round(y), round(x)
        if at_s > best_s[row, column, round(heading * HEADINGS / math.tau) % HEADINGS] + 1e-9:
            continue
        # 1. The end, from the last pose back to the first.
        off_rad = abs((heading - end_rad + math.pi) % math.tau - math.pi)
        if left_s[row, column] <= done_s and not off_rad > math.tau / HEADINGS:
            of_way = [node]
            while of_way[-1] > 0:
                of_way.append(int(nodes[of_way[-1], 4]))
            way: Doubles = nodes[np.array(of_way[::-1])]
            return way
        # 2. All moves from here.
        for k in range(len(moves)):
            along, turn, least_s = moves[k]
            middle = heading + 0.5 * turn
            to_x, to_y, to_heading = x + along * math.cos(middle), y + along * math.sin(middle), heading + turn
            r, c = round(to_y), round(to_x)
            if not (0 <= r < size and 0 <= c < size) or not left_s[r, c] < math.inf:
                continue
            there_s = at_s + max(least_s, abs(along) * cell_s[r, c])
            if node > 0 and moves[int(move), 0] != along:
                there_s += change_s
            there_bin = round(to_heading * HEADINGS / math.tau) % HEADINGS
            if there_s >= best_s[r, c, there_bin] - 1e-9 or count == MOST_NODES:
                continue
            # 3. The room of the base there; where it begins too near to something, it may get no nearer.
            is_free = True
            for disc in discs[0 if along > 0 else 1 if along < 0 else 2]:
                there_x, there_y = to_x + disc * math.cos(to_heading), to_y + disc * math.sin(to_heading)
                there = room_at(room, movers, there_x, there_y, there_s)
                if there < radius:
                    here_x, here_y = x + disc * math.cos(heading), y + disc * math.sin(heading)
                    here = room_at(room, movers, here_x, here_y, at_s)
                    is_free = is_free and here < radius and there >= here
            if is_free:
                best_s[r, c, there_bin] = there_s
                nodes[count, :] = (to_x, to_y, to_heading, there_s, float(node), float(k))
                heapq.heappush(queue, (there_s + left_s[r, c], count))
                count += 1
    return nodes[:0]
