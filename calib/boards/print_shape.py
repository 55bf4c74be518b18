"""The shape of a printed board: paper that curls, a plate that gives way, a printer that stretches one side.

The drawing's points lie in a plane. A print differs from it to second order: out of the plane by a quadratic surface,
in the plane by the ratio of its sides. mrcal models the first by two parabolas along the sides ("calobject_warp"); the
third term, the twist, holds a board that curls about its diagonal.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from calib.models.camera import Array

MODE_NAMES = ("bend_x", "bend_y", "twist", "stretch")
# The modes that move points out of the plane come first, because bends are kept or left out together.
BENDS = 3
# One step of a mode, a millimetre of height and a hundredth of the sides' ratio, because each is about a pixel of a
# near board.
MODE_UNITS = np.array([1e-3, 1e-3, 1e-3, 1e-2])


@dataclass(frozen=True, slots=True)
class PrintShape:
    """Difference of a print from its drawing.

    With u, v from -1 to 1 along the sides x and y of the corners, points are higher by bend_x (1 - u^2) + bend_y
    (1 - v^2) + twist u v [m]. Lengths along y are longer by the part stretch / 2, those along x shorter.
    """

    values: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)  # in the order of MODE_NAMES

    @property
    def is_as_drawn(self) -> bool:
        """True if the print does not differ from its drawing."""
        return not any(self.values)

    @property
    def bends_m(self) -> tuple[float, ...]:
        """Return bend_x, bend_y and twist [m]."""
        return self.values[:BENDS]

    @property
    def stretch(self) -> float:
        """Return the part by which y is longer against x."""
        return self.values[BENDS]

    @property
    def free(self) -> Array:
        """Return the mask (4,) of the modes that are estimated: bends all together, and the stretch."""
        return np.repeat([any(self.bends_m), self.stretch != 0.0], [BENDS, 1])

    def points(self, drawn: Array) -> Array:
        """Return the print's corners (N, 3) [m] of those of the drawing (N, 3), z 0."""
        return self.points_of(drawn, drawn)

    def points_of(self, drawn: Array, places: Array) -> Array:
        """Return points (M, 3) [m] of the print at places (M, 3), z 0, in a drawing with corners drawn (N, 3).

        A sheet that bends keeps its lengths: points move inwards by the integral of half its squared slope.
        """
        middle, half = _sides(drawn)
        uv = (places[:, :2] - middle) / half
        moved = places + _moves(uv, half) @ (np.array(self.values) / MODE_UNITS)
        moved[:, :2] -= 2 / 3 * np.array(self.bends_m[:2]) ** 2 * uv**3 / half
        return np.asarray(moved)

    def modes(self, drawn: Array) -> Array | None:
        """Return the moves (N, 3, S) [m] of the points by one step of each free mode; None if there is none."""
        return all_modes(drawn)[:, :, self.free] if self.free.any() else None

    def moved(self, steps: Array) -> PrintShape:
        """Return the shape after steps (S,) of its free modes."""
        values = np.array(self.values)
        values[self.free] += steps * MODE_UNITS[self.free]
        return _of(values)

    def sag_m(self, drawn: Array) -> float:
        """Return the range of the heights [m] over the corners, above the plane that fits them best."""
        heights = self.points(drawn)[:, 2]
        plane = np.column_stack([drawn[:, :2], np.ones(len(drawn))])
        return float(np.ptp(heights - plane @ np.linalg.lstsq(plane, heights, rcond=None)[0]))

    def notes(self, drawn: Array) -> list[str]:
        """Return a line for each difference of the print from its drawing (N, 3)."""
        notes = []
        if any(self.bends_m):
            notes.append(
                f"your board is bent by {1e3 * self.sag_m(drawn):.2g} mm, which the calibration allows for; mount it "
                "on glass or aluminium for the next one"
            )
        if self.stretch:
            longer, other = ("y (down the rows)", "x") if self.stretch > 0 else ("x (along the columns)", "y")
            notes.append(
                f"your print is {100 * abs(self.stretch):.2g} % longer along {longer} than along {other}, which the "
                "calibration allows for: give the mean of both sides of the squares as their length"
            )
        return notes


AS_DRAWN = PrintShape()


def all_modes(drawn: Array) -> Array:
    """Return the moves (N, 3, 4) [m] of a drawing's corners (N, 3) by one step of every mode."""
    middle, half = _sides(drawn)
    return _moves((drawn[:, :2] - middle) / half, half)


def significant_part(steps: Array, kept: Array) -> PrintShape:
    """Return the shape of steps (4,) from the drawing, of the modes kept (4,) only."""
    return _of(np.where(kept, steps * MODE_UNITS, 0.0))


def _of(values: Array) -> PrintShape:
    bend_x, bend_y, twist, stretch = values.tolist()
    return PrintShape((bend_x, bend_y, twist, stretch))


def _sides(drawn: Array) -> tuple[Array, Array]:
    """Return the middle (2,) of a board's corners, and half their sides (2,) [m]."""
    low, high = drawn[:, :2].min(axis=0), drawn[:, :2].max(axis=0)
    return (low + high) / 2, (high - low) / 2


def _moves(uv: Array, half: Array) -> Array:
    """Return the moves (N, 3, 4) [m] by one step of every mode, of places (N, 2) in parts of half the sides."""
    moves = np.zeros((len(uv), 3, len(MODE_NAMES)))
    moves[:, 2, :BENDS] = np.column_stack([1 - uv**2, uv[:, :1] * uv[:, 1:]])
    moves[:, :2, BENDS] = uv * half * (-0.5, 0.5)
    return np.asarray(moves * MODE_UNITS)
