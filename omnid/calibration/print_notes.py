"""Notes on the print of a board that a calibration has found."""

from __future__ import annotations

from calib.boards.board import CalibrationBoard
from calib.boards.print_shape import PrintShape


def print_shape_notes(shape: PrintShape, board: CalibrationBoard) -> list[str]:
    """Return a line for each difference of the print from its drawing."""
    notes = []
    if any(shape.bends_m):
        notes.append(
            f"your board is bent by {1e3 * shape.sag_m(board.points):.2g} mm, which the calibration allows for; "
            "mount it on glass or aluminium for the next one"
        )
    if shape.stretch:
        longer, other = ("y (down the rows)", "x") if shape.stretch > 0 else ("x (along the columns)", "y")
        notes.append(
            f"your print is {100 * abs(shape.stretch):.2g} % longer along {longer} than along {other}, which the "
            "calibration allows for: give the mean of both sides of the squares as their length"
        )
    return notes
