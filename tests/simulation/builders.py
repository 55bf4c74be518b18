"""Seeded worlds: corridors and rooms with boxes, worlds for the recognition of places; floor at z = 0."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np

from calib.models.camera import Array
from omnid.simulation.rendering import surfaces
from omnid.simulation.rendering.surfaces import (
    CEILING_M,
    PX_PER_M,
    Point,
    Random,
    Rectangle,
    Scene,
    painted,
    poster_paint,
    posters,
    solid,
)
from tests.simulation.paths import planar_poses

# Number of worlds of each kind that are kept, as many tests show the same; their textures are a few megabytes each.
KEPT = 6


def box(rng: Random, centre: Point, size_m: tuple[float, float, float], yaw_rad: float) -> list[Rectangle]:
    """Return a box on the floor: four sides and the top, each with a texture of its own."""
    return solid((*centre, 0.0), size_m, yaw_rad, poster_paint(rng), is_raised=False)


def wall(rng: Random, kind: str, left: Point, right: Point) -> Rectangle:
    """Return a wall from floor to ceiling between two points (x, y) [m], left and right as seen from inside."""
    a, b = np.array([*left, CEILING_M]), np.array([*right, CEILING_M])
    return Rectangle(
        a, b - a, np.array([0, 0, -CEILING_M]), painted(rng, kind, (float(np.linalg.norm(b - a)), CEILING_M)), kind
    )


def _flat(rng: Random, kind: str, low: Point, high: Point) -> tuple[Rectangle, Rectangle]:
    """Return floor (of that kind) and ceiling (tiles) between two corners (x, y) [m]."""
    (x0, y0), (x1, y1) = low, high
    size = (x1 - x0, y1 - y0)
    along = np.array([x1 - x0, 0.0, 0])
    floor = Rectangle(np.array([x0, y1, 0]), along, np.array([0, y0 - y1, 0.0]), painted(rng, kind, size), "floor")
    ceiling = Rectangle(
        np.array([x0, y0, CEILING_M]), along, np.array([0, y1 - y0, 0.0]), painted(rng, "tiles", size), "ceiling"
    )
    return floor, ceiling


def _enclosed(rng: Random, kinds: tuple[str, ...], low: Point, high: Point) -> list[Rectangle]:
    """Return left (+y), right (-y), front (+x) and back wall, then floor and ceiling, of a box-shaped space."""
    (x0, y0), (x1, y1) = low, high
    ends = [((x0, y1), (x1, y1)), ((x1, y0), (x0, y0)), ((x1, y1), (x1, y0)), ((x0, y0), (x0, y1))]
    walls = [wall(rng, kind, a, b) for kind, (a, b) in zip(kinds[:4], ends, strict=True)]
    return [*walls, *_flat(rng, kinds[4], low, high)]


@lru_cache(KEPT)
def corridor(seed: int, length_m: float = 8.0, kinds: tuple[str, ...] | None = None, posters_per_8m: int = 6) -> Scene:
    """Return two walls 1.5 to 3 m apart along x with end walls, floor, ceiling, posters and a few low boxes.

    x runs from -2 to length_m - 2, y = 0 lies between the walls. kinds: textures of the left, right, front and back
    wall and the floor; by default one of the two walls is brick and the other one is random.
    """
    rng = np.random.default_rng([seed, 1])
    if kinds is None:
        pair = ["brick", str(rng.choice(["brick", "plaster", "granite"]))]
        rng.shuffle(pair)
        kinds = (*pair, str(rng.choice(["brick", "granite"])), str(rng.choice(["granite", "plaster"])), "tiles")
    left, right = rng.uniform(0.9, 1.6), -rng.uniform(0.8, 1.4)
    space = _enclosed(rng, kinds, (-2.0, right), (length_m - 2.0, left))
    long, short = max(1, round(posters_per_8m * length_m / 8)), min(posters_per_8m, 2)
    hung: list[Rectangle] = []
    for side, count in zip(space[:4], (long, long, short, short), strict=True):
        hung += posters(rng, side, count, len(hung))
    boxes = [face for x in np.arange(-1.2, length_m - 2.5, 2.2) for face in _by_a_wall(rng, x, (right, left))]
    return Scene((*space, *hung, *boxes))


def _by_a_wall(rng: Random, x: float, walls: Point) -> list[Rectangle]:
    """Return a low box at one of the walls y = walls[0] or walls[1]."""
    size = (rng.uniform(0.2, 0.4), rng.uniform(0.15, 0.25), rng.uniform(0.25, 0.8))
    at_left = bool(rng.integers(2))
    y = walls[1] - 0.2 if at_left else walls[0] + 0.2
    return box(rng, (x + rng.uniform(-0.5, 0.5), y), size, rng.uniform(-0.15, 0.15))


@lru_cache(KEPT)
def room(seed: int, size_m: Point = (6.0, 5.0), boxes: int = 8, kinds: tuple[str, ...] | None = None) -> Scene:
    """Return a room about the origin with posters and boxes up to 1.5 m high at its walls; 1.3 m around 0 are free."""
    rng = np.random.default_rng([seed, 2])
    half = (size_m[0] / 2, size_m[1] / 2)
    drawn = tuple(str(k) for k in rng.choice(["brick", "plaster", "granite", "plain"], 4))
    space = _enclosed(rng, kinds or (*drawn, "tiles"), (-half[0], -half[1]), half)
    hung: list[Rectangle] = []
    for side in space[:4]:
        hung += posters(rng, side, 3, len(hung))
    standing: list[Rectangle] = []
    for angle in np.linspace(0, 2 * np.pi, boxes, endpoint=False) + rng.uniform(0, 1):
        radius = 0.8 * min(half[0] / max(abs(np.cos(angle)), 1e-3), half[1] / max(abs(np.sin(angle)), 1e-3))
        size = tuple(rng.uniform((0.3, 0.3, 0.4), (0.6, 0.6, 1.5)))
        at = (float(radius * np.cos(angle)), float(radius * np.sin(angle)))
        standing += box(rng, at, (size[0], size[1], size[2]), rng.uniform(0, np.pi))
    return Scene((*space, *hung, *standing))


KINDS = ("brick", "plaster", "granite", "plaster")
FLAT_PX_PER_M = 160.0  # of floor and ceiling
BEND_M = 0.7  # radius of the path in the corners
TURN_DEG = 12.0  # between two pairs, where the robot turns round
RING_M: Point = (7.2, 6.0)
CORRIDOR_M = 1.8


def ring(seed: int) -> Scene:
    """Return a corridor of width CORRIDOR_M around a block, with posters and low boxes; the corner of it is at 0, 0."""
    rng = np.random.default_rng([seed, 31])
    (length, width), c = RING_M, CORRIDOR_M
    outer = [(0.0, width), (length, width), (length, 0.0), (0.0, 0.0)]
    inner = [(c, c), (length - c, c), (length - c, width - c), (c, width - c)]
    walls = [
        wall(rng, str(rng.choice(KINDS)), a, b)
        for corners in (outer, inner)
        for a, b in zip(corners, corners[1:] + corners[:1], strict=True)
    ]
    hung = [p for n, side in enumerate(walls) for p in posters(rng, side, round(side.width_m / 1.3), 100 * n)]
    low = [
        face
        for x in np.arange(1.2, length - 1.0, 2.4)
        for y in (0.2, width - 0.2)
        for face in box(
            rng,
            (float(x + rng.uniform(-0.5, 0.5)), y),
            (0.3, float(rng.uniform(0.15, 0.25)), float(rng.uniform(0.3, 0.9))),
            0.0,
        )
    ]
    return Scene((*walls, *_floor_and_ceiling(rng, RING_M), *hung, *low))


def _floor_and_ceiling(rng: Random, size_m: Point) -> list[Rectangle]:
    along, across = np.array([size_m[0], 0, 0]), np.array([0, size_m[1], 0])
    size = (round(size_m[0] * FLAT_PX_PER_M), round(size_m[1] * FLAT_PX_PER_M))
    floor, ceiling = (surfaces.tiles(rng, size, FLAT_PX_PER_M) for _ in range(2))
    return [
        Rectangle(across, along, -across, floor, "floor"),
        Rectangle(np.array([0, 0, CEILING_M]), along, across, ceiling, "ceiling"),
    ]


def two_laps_path(seed: int, pairs: int) -> Array:
    """Return poses of two laps along the ring: the second one beside the first, and from its half on the way back.

    So all of the second lap has been seen before, half of it in the opposite direction.
    """
    rng = np.random.default_rng([seed, 32])
    turning = min(round(180 / TURN_DEG) - 1, pairs // 2)
    driving = pairs - turning
    there, back = driving * 3 // 4, driving - driving * 3 // 4
    phases = rng.uniform(0, 2 * np.pi, 2)
    aside_m = (-1.0, 1.0)[int(rng.integers(2))] * rng.uniform(0.2, 0.3)
    laps = np.linspace(0, 1.5, there)
    first = _beside(laps, aside_m * np.clip((laps - 0.9) / 0.2, 0, 1), phases)
    laps = np.linspace(1.5, 1.0, back)
    last = _beside(laps, np.full(back, -0.5 * aside_m) + 1.5 * aside_m * np.clip((laps - 1.4) / 0.1, 0, 1), phases)
    spin = first[1][-1] + np.deg2rad(TURN_DEG) * np.arange(1, turning + 1)
    xy = np.concatenate([first[0], np.repeat(first[0][-1:], turning, axis=0), last[0]])
    return planar_poses(xy, np.concatenate([first[1], spin, last[1] + np.pi]))


def _beside(laps: Array, aside_m: Array, phases: Array) -> tuple[Array, Array]:
    """Return places (N, 2) and headings (N,) at numbers of laps (N,), so far to the left of the middle (N,)."""

    def place(at: Array) -> Array:
        middle, normal = _centre_line(at % 1.0)
        sway = 0.05 * np.sin(10 * np.pi * at + phases[0]) + 0.04 * np.sin(16 * np.pi * at + phases[1])
        return middle + (aside_m + sway)[:, None] * normal

    ahead = place(laps + 2e-3) - place(laps - 2e-3)
    return place(laps), np.unwrap(np.arctan2(ahead[:, 1], ahead[:, 0]))


def _centre_line(share: Array) -> tuple[Array, Array]:
    """Return places (N, 2) on the middle of the corridor, counter-clockwise, and normals (N, 2) to the left of it."""
    half = CORRIDOR_M / 2
    low, high = np.array([half, half]) + BEND_M, np.array(RING_M) - half - BEND_M
    centres = [(high[0], low[1]), (high[0], high[1]), (low[0], high[1]), (low[0], low[1])]
    angles = [np.linspace(-np.pi / 2, 0, 60) + number * np.pi / 2 for number in range(4)]
    arcs = [
        centre + BEND_M * np.column_stack([np.cos(angle), np.sin(angle)])
        for centre, angle in zip(centres, angles, strict=True)
    ]
    start = np.array([[(low[0] + high[0]) / 2, half]])
    line = np.vstack([start, *arcs, start])
    outward = np.concatenate([[-np.pi / 2], *angles, [3 * np.pi / 2]])
    arc = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
    at = share * arc[-1]
    direction = np.interp(at, arc, outward)
    xy = np.column_stack([np.interp(at, arc, line[:, 0]), np.interp(at, arc, line[:, 1])])
    return xy, -np.column_stack([np.cos(direction), np.sin(direction)])


def twin_corridor(seed: int, period_m: float = 6.0) -> Scene:
    """Return a corridor whose second half repeats the first one in every texture, poster and box."""
    first = corridor(seed, period_m)
    again = tuple(replace(r, origin=r.origin + np.array([period_m, 0, 0])) for r in first if not _is_end(r))
    return Scene(
        (
            *(r for r in first if not _is_end(r) or r.origin[0] < 0),
            *again,
            *(
                replace(r, origin=r.origin + np.array([period_m, 0, 0]))
                for r in first
                if _is_end(r) and r.origin[0] > 0
            ),
        )
    )


def _is_end(rectangle: Rectangle) -> bool:
    """True for what stands across the corridor beyond its first and last half metre."""
    corners = rectangle.corners[:, 0]
    return bool(np.ptp(corners) < 0.01 and (corners.max() < -1.9 or (corners.min() > 3.0 and rectangle.width_m > 1)))


def bricks(seed: int, length_m: float = 10.0) -> Scene:
    """Return a corridor of nothing but identical bricks and two plain ends."""
    scene = corridor(seed, length_m, ("brick", "brick", "brick", "brick", "brick"), posters_per_8m=0)
    return Scene(tuple(r for r in scene if r.name not in ("box",)))


def symmetric_room(seed: int, size_m: Point = (6.0, 5.0)) -> Scene:
    """Return an empty room that looks the same after half a turn about its middle."""
    rng = np.random.default_rng([seed, 33])
    x, y = size_m[0] / 2, size_m[1] / 2
    sides = [wall(rng, "granite", (-x, y), (x, y)), wall(rng, "plaster", (x, y), (x, -y))]
    turn = np.diag([-1.0, -1.0, 1.0])
    opposite = [Rectangle(turn @ r.origin, turn @ r.edge_u, turn @ r.edge_v, r.texture, r.name) for r in sides]
    half = surfaces.tiles(rng, (round(size_m[0] * PX_PER_M / 2), round(size_m[1] * PX_PER_M / 4)), PX_PER_M / 2)
    both = np.ascontiguousarray(np.vstack([half, half[::-1, ::-1]]))
    across, along = np.array([0, size_m[1], 0]), np.array([size_m[0], 0, 0])
    floor = Rectangle(np.array([-x, y, 0]), along, -across, both, "floor")
    ceiling = Rectangle(np.array([-x, -y, CEILING_M]), along, across, both, "ceiling")
    return Scene((*sides, *opposite, floor, ceiling))


def repeating(seed: int, length_m: float, period_m: float = 0.3) -> Scene:
    """Return a corridor that looks the same again after each period along it, on walls, floor and ceiling.

    Its ends are half the length away from x = 0.
    """
    scene = corridor(seed, length_m, ("granite",) * 5, posters_per_8m=0)
    back = np.array([2.0 - length_m / 2, 0.0, 0.0])
    return Scene(
        tuple(
            replace(r, origin=r.origin + back, texture=_repeated(r, period_m))
            for r in scene
            if not r.name.startswith("box")
        )
    )


def _repeated(rectangle: Rectangle, period_m: float) -> np.ndarray:
    """Return the texture of a rectangle, of which the first period along its width is repeated."""
    texture, columns = rectangle.texture, round(period_m * rectangle.texture.shape[1] / rectangle.width_m)
    return np.ascontiguousarray(
        np.tile(texture[:, :columns], (1, -(-texture.shape[1] // columns)))[:, : texture.shape[1]]
    )
