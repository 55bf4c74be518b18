"""Parts of buildings as they are: painted walls with doors and skirting boards, lit ceilings, windows, furniture.

A `Builder` collects the surfaces of one world; all greys follow from its random generator.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Final

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from calib.models.camera import Array
from omnid.simulation.rendering import surfaces
from omnid.simulation.rendering.surfaces import (
    CEILING_M,
    PAINTERS,
    Paint,
    Painter,
    Point,
    Random,
    Rectangle,
    Size,
    Texture,
    grey_of,
    pixels_of,
    solid,
    stretched,
    value_noise,
)

Point3 = tuple[float, float, float]
# A box of an object: the middle of its bottom, x, y, z, from the middle of the object, then its sides along them [m].
Part = tuple[float, float, float, float, float, float]
WALL_PX_PER_M: Final = 100.0
THING_PX_PER_M: Final = 250.0
MOST_FLOOR_PX: Final = 6e6  # of one floor
BEHIND_M: Final = 2.0  # of the start, where a corridor begins
GAP_M: Final = 0.003  # of what hangs on a wall from it
UP: Final = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True, slots=True)
class Opening:
    """A door that stands open in a wall, by its distance from the wall's beginning."""

    at_m: float
    width_m: float
    height_m: float = 2.1


def four_legs(aside_m: Point, side_m: float, height_m: float) -> list[Part]:
    """Return four legs; aside_m: of their middles from the middle of the object, along x and y."""
    x, y = aside_m
    return [(i * x, j * y, 0.0, side_m, side_m, height_m) for i in (1, -1) for j in (1, -1)]


def plain_paint(rng: Random, grey: float, grain: float = 0.8, px_per_m: float = THING_PX_PER_M) -> Paint:
    """Return what paints a face in one grey with a little grain."""

    def paint(sides_m: Point) -> Texture:
        width, height = (max(8, round(side_m * px_per_m)) for side_m in sides_m)
        noise = grain * rng.standard_normal((height, width), np.float32)
        return np.asarray(np.clip(np.rint(grey + cv2.GaussianBlur(noise, (0, 0), 0.8)), 0, 255), np.uint8)

    return paint


def poster_paint(rng: Random) -> Paint:
    """Return what paints a face as a printed page, a drawing or a photograph."""
    return lambda sides_m: surfaces.poster(rng, _px(sides_m))


class Builder:
    """Collects the surfaces of a world."""

    def __init__(self, rng: Random, floor: str) -> None:
        """floor: the kind of its texture."""
        self.rng, self.floor_kind, self.ceiling_m = rng, floor, CEILING_M
        self.faces: list[Rectangle] = []
        self.panes: list[Rectangle] = []  # of glass: they are touched, and mirror a little
        self.wall_grey = float(rng.uniform(165, 215))
        self.skirting_m = float(rng.choice([0.06, 0.08, 0.1]))
        self.skirting_grey = float(rng.choice([60, 95, 215, 235]))
        self.door_grey = float(rng.choice([110, 150, 205, 228]))

    # Floors and ceilings

    def floor(
        self, low: Point, high: Point, heights_m: tuple[float, float] = (0.0, 0.0), kind: str | None = None
    ) -> None:
        """Add a floor between two corners, of two heights at its ends along x."""
        (x0, y0), (x1, y1) = low, high
        px_per_m = min(THING_PX_PER_M, math.sqrt(MOST_FLOOR_PX / ((x1 - x0) * (y1 - y0))))
        pixels = pixels_of((x1 - x0, y1 - y0), px_per_m)
        texture = FLOOR_PAINTERS[kind or self.floor_kind](self.rng, pixels, px_per_m)
        texture = _lit(texture, self._falloff((x1 - x0, y1 - y0), edge_m=0.12))
        along = np.array([x1 - x0, 0.0, heights_m[1] - heights_m[0]])
        self.faces.append(
            Rectangle(np.array([x0, y1, heights_m[0]]), along, np.array([0.0, y0 - y1, 0.0]), texture, "floor")
        )

    def ceiling(self, low: Point, high: Point, lamps_apart_m: float = 2.4) -> None:
        """Add a ceiling of panels with lamps in rows along x."""
        (x0, y0), (x1, y1), top_m = low, high, self.ceiling_m
        size_m, px_per_m = (x1 - x0, y1 - y0), 60.0
        grey = self.rng.uniform(185, 205)
        texture = np.full((round(size_m[1] * px_per_m), round(size_m[0] * px_per_m)), grey, np.uint8)
        if self.rng.random() < 0.6:  # panels in a grid
            step = round(0.6 * px_per_m)
            texture[::step], texture[:, ::step] = grey - 45, grey - 45
        panel = Rectangle(
            np.array([x0, y0, top_m]), np.array([size_m[0], 0.0, 0.0]), np.array([0.0, size_m[1], 0.0]), texture, "top"
        )
        self.faces.append(panel)
        lamp = np.full((8, 8), 255, np.uint8)
        rows = max(1, round(size_m[1] / 2.8))
        for y in (np.arange(rows) + 0.5) * size_m[1] / rows:
            for x in np.arange(lamps_apart_m / 2, size_m[0] - 0.7, lamps_apart_m):
                self.faces.append(panel.poster(lamp, (float(x) - 0.6, float(y) - 0.14, 1.2, 0.28), "lamp"))

    # Walls

    def wall(
        self,
        a: Point,
        b: Point,
        openings: Sequence[Opening] = (),
        *,
        doors: int = 0,
        windows: int = 0,
        pictures: int = 0,
        grey: float | None = None,
        skirting: bool = True,
    ) -> None:
        """Add a painted wall between two points, left and right as seen from its front, with what hangs on it."""
        rng, top_m = self.rng, self.ceiling_m
        first, last = np.array([*a, 0.0]), np.array([*b, 0.0])
        length_m = float(np.linalg.norm(last - first))
        along = (last - first) / length_m
        grey = self.wall_grey + rng.uniform(-6, 6) if grey is None else grey
        begin_m, full = 0.0, []  # stretches from the floor to the ceiling
        for opening in sorted(openings, key=lambda one: one.at_m):
            full.append((begin_m, opening.at_m))
            end_m = opening.at_m + opening.width_m
            self._wall_piece(first + opening.at_m * along, opening.width_m * along, opening.height_m, top_m, grey)
            for at_m in (opening.at_m - 0.06, end_m):  # the frame
                self._strip(first, along, (at_m, 0.06), (0.0, opening.height_m + 0.06), self.door_grey, "frame")
            begin_m = end_m
        full.append((begin_m, length_m))
        for begin_m, end_m in full:
            if end_m - begin_m > 0.02:
                self._wall_piece(first + begin_m * along, (end_m - begin_m) * along, 0.0, top_m, grey)
        # What is on the wall, left to right without overlaps.
        wanted = ["door"] * doors + ["window"] * windows + ["picture"] * pictures
        rng.shuffle(wanted)
        usable = [(p, q) for p, q in full if q - p > 1.3]
        gaps = [[begin_m, begin_m] for begin_m, _ in full]  # where a door interrupts the skirting board
        if usable and wanted:
            spans = [q - p for p, q in usable]
            slots = np.cumsum([0.0, *spans])
            width_m = slots[-1] / len(wanted)
            for number, kind in enumerate(wanted):
                at = number * width_m
                part = int(np.searchsorted(slots[1:-1], at, side="right"))
                left_m = usable[part][0] + at - slots[part]
                room_m = min(width_m, usable[part][1] - left_m)
                size_m = {"door": 1.0, "window": 1.4, "picture": 0.5}[kind]
                if room_m < size_m + 0.2:
                    continue
                left_m += rng.uniform(0.1, room_m - size_m - 0.1)
                if kind == "door":
                    self._door(first, along, left_m)
                    gaps.append([left_m, left_m + size_m])
                elif kind == "window":
                    self._window(first, along, left_m, size_m)
                else:
                    height_m = rng.uniform(0.3, 0.6)
                    page = surfaces.poster(rng, (150, round(300 * height_m)))
                    self._hang(first, along, (left_m, 0.5), (1.3, 1.3 + height_m), page, "poster", 0.01)
        if skirting:
            for begin_m, end_m in full:
                cuts = sorted([p, q] for p, q in gaps if begin_m <= p < end_m)
                at_m = begin_m
                for p, q in [*cuts, [end_m, end_m]]:
                    if p - at_m > 0.02:
                        self._strip(
                            first, along, (at_m, p - at_m), (0.0, self.skirting_m), self.skirting_grey, "skirting"
                        )
                    at_m = max(at_m, q)

    def partition(
        self, x_m: float, ends_m: tuple[float, float], openings: Sequence[Opening], thick_m: float = 0.12
    ) -> None:
        """Add an inner wall across x, with two sides and the reveals of its openings; at_m from the larger y."""
        low_m, high_m = sorted(ends_m)
        front, back = x_m, x_m + thick_m
        length_m = high_m - low_m
        self.wall((front, high_m), (front, low_m), openings, grey=self.wall_grey)
        mirrored = [replace(one, at_m=length_m - one.at_m - one.width_m) for one in openings]
        self.wall((back, low_m), (back, high_m), mirrored, grey=self.wall_grey)
        for one in openings:
            left_m = high_m - one.at_m
            through = np.array([thick_m, 0.0])
            for y_m in (left_m, left_m - one.width_m):
                start = np.array([front, y_m])
                self.upright(start, start + through, (0.0, one.height_m), self.door_grey)
            paint = plain_paint(self.rng, self.door_grey, px_per_m=WALL_PX_PER_M)
            origin = np.array([front, left_m, one.height_m])
            across = np.array([0.0, -one.width_m, 0.0])
            self.faces.append(
                Rectangle(origin, np.array([thick_m, 0.0, 0.0]), across, paint((thick_m, one.width_m)), "lintel")
            )

    def room(self, low: Point, high: Point, *, doors: int = 1, windows: int = 0, pictures: int = 1) -> None:
        """Add four walls around a rectangle: windows in the long left one, doors in both long ones."""
        (x0, y0), (x1, y1) = low, high
        self.wall((x0, y1), (x1, y1), doors=doors * (not windows), windows=windows, pictures=pictures)
        self.wall((x1, y1), (x1, y0), pictures=1)
        self.wall((x1, y0), (x0, y0), doors=doors, pictures=pictures)
        self.wall((x0, y0), (x0, y1), doors=1)

    def space(self, low: Point, high: Point, **room: int) -> None:
        """Add floor, ceiling and four walls of a room; room: the doors, windows and pictures of `room`."""
        self.floor(low, high)
        self.ceiling(low, high)
        self.room(low, high, **room)

    def upright(self, a: ArrayLike, b: ArrayLike, heights_m: Point, grey: float) -> None:
        """Add a bare upright rectangle between two points, left and right as seen from its front."""
        (low_m, high_m), start = heights_m, np.array([*np.asarray(a), 0.0])
        along = np.array([*np.asarray(b), 0.0]) - start
        size_m = (float(np.linalg.norm(along)), high_m - low_m)
        texture = plain_paint(self.rng, grey, px_per_m=WALL_PX_PER_M)(size_m)
        self.faces.append(Rectangle(start + high_m * UP, along, (low_m - high_m) * UP, texture, "wall"))

    def _wall_piece(self, start: Array, along: Array, low_m: float, top_m: float, grey: float) -> None:
        size_m = (float(np.linalg.norm(along)), top_m - low_m)
        texture = plain_paint(self.rng, grey, 1.2, WALL_PX_PER_M)(size_m)
        texture = _lit(texture, self._falloff(size_m, edge_m=0.05))
        self.faces.append(Rectangle(start + top_m * UP, along, (low_m - top_m) * UP, texture, "wall"))

    def _falloff(self, size_m: Point, edge_m: float) -> Array:
        """Return the light (H, W) on a surface: brighter below lamps, darker in corners."""
        phase = self.rng.uniform(0, math.tau)
        x, y = (np.linspace(0.0, side_m, max(8, min(400, round(side_m / 0.03)))) for side_m in size_m)
        waves = 1 + 0.05 * np.cos(math.tau * x / 2.4 + phase)
        corners = [1 - 0.12 * (np.exp(-at / edge_m) + np.exp(-(at[-1] - at) / edge_m)) for at in (x, y)]
        return np.asarray(np.outer(corners[1], waves * corners[0]))

    def _hang(
        self, first: Array, along: Array, span_m: Point, heights_m: Point, texture: Texture, name: str, off_m: float
    ) -> None:
        """Add a rectangle before a wall; span: its beginning and width."""
        inwards = np.array([along[1], -along[0], 0.0])
        origin = first + span_m[0] * along + heights_m[1] * UP + off_m * inwards
        self.faces.append(Rectangle(origin, span_m[1] * along, (heights_m[0] - heights_m[1]) * UP, texture, name))

    def _strip(self, first: Array, along: Array, span_m: Point, heights_m: Point, grey: float, name: str) -> None:
        """Add a strip that stands 1.2 cm before a wall, with its upper edge."""
        texture = plain_paint(self.rng, grey, px_per_m=WALL_PX_PER_M)((span_m[1], heights_m[1] - heights_m[0]))
        self._hang(first, along, span_m, heights_m, texture, name, 0.012)
        inwards = 0.012 * np.array([along[1], -along[0], 0.0])
        top = first + span_m[0] * along + heights_m[1] * UP
        self.faces.append(Rectangle(top, span_m[1] * along, inwards, texture[:8], name))

    def _door(self, first: Array, along: Array, left_m: float) -> None:
        """Add a closed door with its frame and handle, and the switch beside it."""
        width, height, scale = 1.0, 2.1, 200
        image = np.full((round(height * scale), round(width * scale)), self.door_grey, np.uint8)
        frame = round(0.07 * scale)
        dark = max(0.0, self.door_grey - 70)
        image[frame - 2 : frame], image[frame:, frame - 2 : frame], image[frame:, -frame : 2 - frame] = dark, dark, dark
        image[-2:] = 30
        cv2.rectangle(image, (round(0.84 * scale), 205), (round(0.87 * scale), 240), 70, -1)
        cv2.line(image, (round(0.75 * scale), 213), (round(0.86 * scale), 213), 200, 4)
        if self.rng.random() < 0.5:
            cv2.putText(image, str(self.rng.integers(100, 400)), (70, 110), cv2.FONT_HERSHEY_SIMPLEX, 0.7, 40, 2)
        self._hang(first, along, (left_m, width), (0.0, height), image, "door", 2 * GAP_M)
        switch = np.full((16, 16), 235, np.uint8)
        switch[7:9], switch[0], switch[-1] = 190, 150, 120
        self._hang(first, along, (left_m - 0.16, 0.08), (1.02, 1.1), switch, "switch", 0.01)

    def _window(self, first: Array, along: Array, left_m: float, width_m: float) -> None:
        """Add a window: bright panes, bars, a frame; a radiator stands below it."""
        image = np.full((130, round(100 * width_m)), 255, np.uint8)
        image[80:] = 235
        for bar in (0, image.shape[1] // 2 - 3, image.shape[1] - 6):
            image[:, bar : bar + 6] = 205
        image[:6], image[-6:] = 205, 205
        self._hang(first, along, (left_m, width_m), (0.9, 2.2), image, "window", GAP_M)
        ribs = np.full((60, round(100 * width_m)), 215, np.uint8)
        ribs[:, ::5] = 175
        self._hang(first, along, (left_m, width_m), (0.12, 0.72), ribs, "radiator", 0.08)

    # Objects

    def object(self, parts: Iterable[Part], at: Point, yaw_rad: float, paint: Paint) -> None:
        """Add the boxes of one object."""
        c, s = math.cos(yaw_rad), math.sin(yaw_rad)
        for x, y, z, length_m, width_m, height_m in parts:
            place, size_m = (at[0] + c * x - s * y, at[1] + s * x + c * y, z), (length_m, width_m, height_m)
            self.faces += solid(place, size_m, yaw_rad, paint, name="box", is_raised=z > 0)

    def star_chair(self, at: Point, yaw_rad: float) -> None:
        """Add an office chair: five legs, a column, a seat and a back."""
        legs = plain_paint(self.rng, self.rng.uniform(25, 190))
        cloth = plain_paint(self.rng, self.rng.uniform(35, 110), 5)
        for number in range(5):
            angle = yaw_rad + number * math.tau / 5
            c, s = math.cos(angle), math.sin(angle)
            leg, castor = ((at[0] + away_m * c, at[1] + away_m * s) for away_m in (0.16, 0.3))
            self.faces += solid((*leg, 0.06), (0.3, 0.045, 0.035), angle, legs)
            self.faces += solid((*castor, 0.0), (0.05, 0.05, 0.06), angle, legs, is_raised=False)
        self.object([(0.0, 0.0, 0.08, 0.06, 0.06, 0.36)], at, yaw_rad, legs)
        self.object([(0.0, 0.0, 0.44, 0.46, 0.48, 0.08), (-0.22, 0.0, 0.58, 0.06, 0.42, 0.5)], at, yaw_rad, cloth)

    def table(self, at: Point, size_m: Point3, yaw_rad: float = 0.0) -> None:
        """Add a plate on four legs; size: length, width, height."""
        (length, width, height), thick = size_m, 0.03
        legs = four_legs((length / 2 - 0.05, width / 2 - 0.05), 0.05, height - thick)
        self.object(legs, at, yaw_rad, plain_paint(self.rng, self.rng.uniform(40, 180)))
        plate = [(0.0, 0.0, height - thick, length, width, thick)]
        self.object(plate, at, yaw_rad, plain_paint(self.rng, self.rng.uniform(120, 225), 1.5))

    def shelf(self, at: Point, yaw_rad: float) -> None:
        """Add boards between two sides, with books and boxes on them."""
        width_m = 0.9
        boards = [(0.0, 0.0, z, 0.35, width_m, 0.02) for z in (0.08, 0.45, 0.82, 1.19, 1.56)]
        sides = [(0.0, y, 0.0, 0.35, 0.02, 1.8) for y in (width_m / 2, -width_m / 2)]
        self.object([*boards, *sides], at, yaw_rad, plain_paint(self.rng, self.rng.uniform(120, 210), 1.5))
        for z in (0.1, 0.47, 0.84, 1.21):
            row = (-0.03, 0.0, z, 0.25, width_m - 0.08, self.rng.uniform(0.2, 0.3))
            self.object([row], at, yaw_rad, poster_paint(self.rng))

    def adult(self, height_m: float = 1.75) -> tuple[Rectangle, ...]:
        """Return a person on the origin who looks along x."""
        k, rng, faces = height_m / 1.75, self.rng, list[Rectangle]()
        trousers, shirt, skin = (
            plain_paint(rng, rng.uniform(*span), 4.0) for span in ((30, 110), (50, 210), (120, 180))
        )
        shoes = plain_paint(rng, rng.uniform(25, 80), 3.0)
        parts: list[tuple[Part, Paint]] = []
        for side in (1, -1):
            parts += [((0.06, side * 0.1, 0.0, 0.27, 0.1, 0.09), shoes)]
            parts += [((0.0, side * 0.1, 0.09, 0.15, 0.14, 0.74), trousers)]
            parts += [((0.0, side * 0.26, 0.8, 0.1, 0.1, 0.62), shirt)]
        parts += [((0.0, 0.0, 0.83, 0.22, 0.42, 0.6), shirt), ((0.0, 0.0, 1.45, 0.2, 0.16, 0.3), skin)]
        for (x, y, z, long_m, wide_m, high_m), paint in parts:
            faces += solid((k * x, k * y, k * z), (k * long_m, k * wide_m, k * high_m), 0.0, paint, name="person")
        return tuple(faces)


def corridor(b: Builder, *, width_m: float = 1.8, length_m: float = 14.0) -> tuple[Point, Point]:
    """Add a corridor along x about the way of a robot that starts at the origin; return its corners."""
    aside_m = b.rng.uniform(-0.1, 0.1)
    low, high = (-BEHIND_M, aside_m - width_m / 2), (length_m - BEHIND_M, aside_m + width_m / 2)
    b.floor(low, high)
    b.ceiling(low, high)
    b.room(low, high, doors=int(b.rng.integers(2, 5)), pictures=int(b.rng.integers(1, 4)))
    return low, high


def hall(b: Builder) -> tuple[Point, Point]:
    """Add a hall with windows on one side, and furniture along its walls; return its corners."""
    low, high = (-2.5, -3.5), (11.5, 3.5)
    b.ceiling_m = 3.2
    b.floor(low, high)
    b.ceiling(low, high, 3.0)
    b.room(low, high, doors=2, windows=4, pictures=3)
    for x_m in np.arange(0.5, 10.0, 3.0):
        b.shelf((x_m + b.rng.uniform(-0.5, 0.5), low[1] + 0.22), math.pi / 2)
    for x_m in (2.0, 7.0):
        place = x_m + b.rng.uniform(-1.0, 1.0), high[1] - 1.0
        b.table(place, (1.4, 0.7, 0.74))
        b.star_chair((place[0], place[1] - 0.7), b.rng.uniform(0, math.tau))
    return low, high


def trolley(b: Builder) -> list[Part]:
    """Return a trolley whose handle is behind, with a load or without."""
    bed_m = b.rng.uniform(0.14, 0.24)
    legs = four_legs((0.35, 0.25), 0.08, bed_m)
    handle: list[Part] = [(-0.45, y, bed_m, 0.03, 0.03, 0.7) for y in (0.25, -0.25)]
    bed: list[Part] = [(0.0, 0.0, bed_m, 0.9, 0.6, 0.05), (-0.45, 0.0, bed_m + 0.7, 0.03, 0.53, 0.03)]
    load: list[Part] = [(0.08, 0.0, bed_m + 0.05, 0.6, 0.5, b.rng.uniform(0.2, 0.5))]
    return legs + handle + bed + load * int(b.rng.integers(2))


def put_thing(b: Builder, kind: str, at: Point) -> None:
    """Add an object of a room."""
    rng, yaw_rad = b.rng, b.rng.uniform(0, math.tau)
    if kind == "chair":
        b.star_chair(at, yaw_rad)
    elif kind == "table":
        b.table(at, (0.8, 0.6, 0.72), yaw_rad)
    else:
        spans = {"box": (0.3, 0.6), "carton": (0.3, 0.5), "bin": (0.25, 0.3)}[kind]
        size_m = rng.uniform(*spans), rng.uniform(*spans), rng.uniform(0.3, 0.9)
        grey, grain = rng.uniform(40, 220), 6.0 if kind == "carton" else 1.0
        b.object([(0.0, 0.0, 0.0, *size_m)], at, yaw_rad, plain_paint(rng, grey, grain))


def _px(sides_m: Point) -> tuple[int, int]:
    width, height = (max(16, round(side_m * THING_PX_PER_M)) for side_m in sides_m)
    return width, height


def _lit(texture: Texture, light: Array) -> Texture:
    """Return a texture under a light of a coarser resolution."""
    gain = cv2.resize(light.astype(np.float32), texture.shape[::-1], interpolation=cv2.INTER_LINEAR)
    return np.asarray(np.clip(np.rint(texture * gain), 0, 255), np.uint8)


# Seeded textures of floors of buildings, beside those of omnid's own worlds; all (H, W) uint8.
def concrete(rng: Random, size: Size, px_per_m: float) -> Texture:
    """Return smoothed concrete: clouds, pores, and sawn joints every few metres."""
    image = rng.uniform(115, 150) + 5 * value_noise(rng, size, px_per_m * 0.8, 0.75)
    image += 2.5 * value_noise(rng, size, px_per_m * 0.03, 0.9)
    image -= 25 * (value_noise(rng, size, px_per_m * 0.02) > 3.2)
    for axis, apart_m in ((0, rng.uniform(2.2, 3.2)), (1, rng.uniform(2.2, 3.2))):
        _joints(
            image, axis, round(rng.uniform(0.2, 0.8) * apart_m * px_per_m), apart_m * px_per_m, 0.006 * px_per_m, 70
        )
    return grey_of(image)


def glazed(rng: Random, size: Size, px_per_m: float) -> Texture:
    """Return glazed tiles: nearly one grey each, with joints."""
    side_m = rng.choice([0.3, 0.45, 0.6])
    return _flags(rng, size, px_per_m, side_m, 2.5, 1.2, (0.004, rng.uniform(90, 120)))


def slabs(rng: Random, size: Size, px_per_m: float) -> Texture:
    """Return polished stone: dark slabs with thin joints."""
    return _flags(rng, size, px_per_m, 0.6, 3.0, 5.0, (0.002, 60.0), base=rng.uniform(85, 120))


def _joints(image: Array | NDArray[np.float32], axis: int, first: int, apart: float, wide: float, grey: float) -> None:
    """Draw lines across an axis of an image; one narrower than a pixel has a part of the grey."""
    lines, part = np.moveaxis(image, axis, 0), min(wide, 1.0)
    for at in np.rint(np.arange(first, len(lines), apart)).astype(int):
        lines[at : at + max(1, round(wide))] += part * (grey - lines[at : at + max(1, round(wide))])


def _flags(
    rng: Random,
    size: Size,
    px_per_m: float,
    side_m: float,
    spread: float,
    grain: float,
    joint: tuple[float, float],
    base: float | None = None,
) -> Texture:
    """Return square flags; joint: width [m] and grey."""
    side = side_m * px_per_m
    first = rng.uniform(0, side, 2)
    rows, columns = (
        ((np.arange(n) + side - offset) // side).astype(int) for n, offset in zip(size[::-1], first, strict=True)
    )
    level = (base or rng.uniform(140, 190)) + spread * rng.standard_normal((rows[-1] + 1, columns[-1] + 1))
    image = level[np.ix_(rows, columns)] + grain * value_noise(rng, size, px_per_m * 0.2, 0.75)
    for axis in (0, 1):
        _joints(image, axis, round(first[axis]), side, joint[0] * px_per_m, joint[1])
    return grey_of(image)


def boards(board_m: tuple[float, float], spread: float, grain: float) -> Painter:
    """Return the painter of boards (length, width) along u, each course beginning elsewhere; spread: of their greys."""

    def paint(rng: Random, size: Size, px_per_m: float) -> Texture:
        length, width = (side_m * px_per_m for side_m in board_m)
        base = rng.uniform(105, 150)
        image = base + grain * stretched(rng, size, px_per_m * 0.03, 14.0)
        for top in np.arange(0, size[1], width):
            course = image[round(top) : round(top + width)]
            first = rng.uniform(0, length)
            ends = np.rint(np.arange(first, size[0] + length, length)).astype(int)
            for begin, end in zip([0, *ends], ends, strict=False):
                course[:, begin:end] += spread * rng.standard_normal()
            _joints(course, 1, int(ends[0]), length, 0.0015 * px_per_m, base - 45)
        _joints(image, 0, 0, width, 0.0015 * px_per_m, base - 45)
        return grey_of(image)

    return paint


def across(painter: Painter) -> Painter:
    """Return the painter of a texture along v instead of u."""
    return lambda rng, size, px_per_m: np.ascontiguousarray(painter(rng, size[::-1], px_per_m).T)


PARQUET: Final = boards((0.6, 0.07), 7.0, 3.0)
FLOOR_PAINTERS: Final[dict[str, Painter]] = {
    **PAINTERS,
    "concrete": concrete,
    "glazed": glazed,
    "slabs": slabs,
    "parquet_along": PARQUET,  # staggered oak staves
    "parquet_across": across(PARQUET),
    "laminate": boards((1.28, 0.19), 2.0, 2.5),  # printed planks with fine joints
}
