"""Boards to print: a PDF page true to scale, with a ruler to check the print and the options to calibrate with.

PDF is written directly (ISO 32000-1, 7 and 8): a page of filled rectangles and a few lines of text.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Final, NamedTuple

import cv2
import numpy as np

from calib.boards.board import Board
from calib.boards.marker_board import AprilGrid, CharucoBoard, MarkerLayout
from omnid.errors import OmnidError

PAPERS_MM: Final = {
    "a4": (210.0, 297.0),
    "a3": (297.0, 420.0),
    "a2": (420.0, 594.0),
    "a1": (594.0, 841.0),
    "a0": (841.0, 1189.0),
    "letter": (215.9, 279.4),
    "tabloid": (279.4, 431.8),
}
EDGE_MM: Final = 8.0  # Margin that printers leave free.
FOOT_MM: Final = 22.0  # Room below the board for ruler and text.
RULER_MM: Final = 100.0
_TEXT_MM: Final = 2.8
_POINTS_PER_MM: Final = 72 / 25.4
_INK: Final = "0 g"


class Black(NamedTuple):
    """A black rectangle [mm]; x to the right, y down from the upper left corner of the board's print."""

    x: float
    y: float
    width: float
    height: float


def board_pdf(board: Board | CharucoBoard | AprilGrid, paper: str, options: str) -> bytes:
    """Return a PDF page with a board; OmnidError where it does not fit on the paper, either way round.

    options: of the calibration, printed below the board.
    """
    rectangles = list(black_areas(board))
    width = max(black.x + black.width for black in rectangles)
    height = max(black.y + black.height for black in rectangles)
    page = _page(paper, width, height)
    left, top = (page[0] - width) / 2, EDGE_MM + (page[1] - 2 * EDGE_MM - FOOT_MM - height) / 2
    drawn = [_rectangle(page, left + black.x, top + black.y, black.width, black.height) for black in rectangles]
    foot = page[1] - EDGE_MM
    lines = (
        f"{board}. Print it at 100 %, not fitted to the page, and glue it on a flat plate.",
        f"The line above is {RULER_MM:g} mm long: measure it and the board; give the size that you measured.",
        f"omnid calibrate rig LOG {options} -o rig.toml",
    )
    drawn += [
        *_ruler(page, EDGE_MM, foot - 14.0),
        *(_text(page, EDGE_MM, foot - 8.5 + 4.0 * line, text) for line, text in enumerate(lines)),
    ]
    return _pdf(page, drawn)


def black_areas(board: Board | CharucoBoard | AprilGrid) -> Iterator[Black]:
    """Yield the black rectangles of a board's print."""
    if isinstance(board, AprilGrid):
        yield from _april_grid(board)
        return
    side = 1e3 * board.square_m
    # The board's frame begins at the first inner corner, the print one square before.
    first_dark = not (isinstance(board, CharucoBoard) and board.legacy and board.rows % 2 == 1)
    for row in range(board.rows + 1):
        for column in range(board.columns + 1):
            if ((row + column) % 2 == 0) == first_dark:
                yield Black(column * side, row * side, side, side)
    if isinstance(board, CharucoBoard):
        yield from _markers(board.markers, np.array([side, side]), 1.0)


def _april_grid(board: AprilGrid) -> Iterator[Black]:
    """Yield tags, and the squares that touch their corners; y of the board's frame points up."""
    side, gap = 1e3 * board.tag_m, 1e3 * board.tag_m * board.spacing
    height = board.rows * side + (board.rows - 1) * gap
    yield from _markers(board.markers, np.array([gap, gap + height]), -1.0)
    for row in range(board.rows + 1):
        for column in range(board.columns + 1):
            yield Black(column * (side + gap), row * (side + gap), gap, gap)


def _markers(
    layout: MarkerLayout, origin_mm: np.ndarray[tuple[int], np.dtype[np.float64]], down: float
) -> Iterator[Black]:
    """Yield the black bits of markers, each row of equal bits as one rectangle; down: sign of the frame's y."""
    bits = layout.dictionary.markerSize + 2 * layout.border_bits
    for number, corners in zip(layout.ids, 1e3 * layout.corners, strict=True):
        image = cv2.aruco.generateImageMarker(layout.dictionary, int(number), bits, borderBits=layout.border_bits)
        first, second, _, fourth = origin_mm + corners * [1.0, down]
        along, below = (second - first) / bits, (fourth - first) / bits
        for row, column, count in _runs(image == 0):
            start, end = first + column * along + row * below, first + (column + count) * along + (row + 1) * below
            low, high = np.minimum(start, end), np.maximum(start, end)
            yield Black(float(low[0]), float(low[1]), *(float(size) for size in high - low))


def _runs(dark: np.ndarray[tuple[int, ...], np.dtype[np.bool_]]) -> Iterator[tuple[int, int, int]]:
    """Yield row, column and length of the runs of True in each row."""
    for row, line in enumerate(dark):
        edges = np.flatnonzero(np.diff(np.concatenate([[0], line.astype(np.int8), [0]])))
        for start, end in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True):
            yield row, start, end - start


def _page(paper: str, width: float, height: float) -> tuple[float, float]:
    """Return the sides of the paper [mm] the way round in which the board fits."""
    fitting = {
        name: page
        for name, sides in PAPERS_MM.items()
        for page in (sides[::-1], sides)  # the last one that fits stays: upright before across
        if width <= page[0] - 2 * EDGE_MM and height <= page[1] - 2 * EDGE_MM - FOOT_MM
    }
    if paper in fitting:
        return fitting[paper]
    advice = f"give --paper {next(iter(fitting))}, or" if fitting else "give"
    raise OmnidError(
        f"the board is {width:.0f} x {height:.0f} mm and does not fit on {paper} with a margin of "
        f"{EDGE_MM:g} mm and the ruler; {advice} smaller squares, or fewer of them"
    )


def _rectangle(page: tuple[float, float], x: float, y: float, width: float, height: float) -> str:
    values = (x, page[1] - y - height, width, height)
    return " ".join(f"{value * _POINTS_PER_MM:.4f}" for value in values) + " re f"


def _ruler(page: tuple[float, float], x: float, y: float) -> Iterator[str]:
    """Yield a line of 100 mm with ticks each 10 mm, longer at its ends."""
    yield _rectangle(page, x, y - 0.1, RULER_MM, 0.2)
    for tick in range(0, round(RULER_MM) + 1, 10):
        long = 4.0 if tick in (0, round(RULER_MM)) else 2.0
        start, width = (0.0, 0.2) if tick == 0 else (-0.2, 0.2) if tick == RULER_MM else (-0.1, 0.2)
        yield _rectangle(page, x + tick + start, y - long / 2, width, long)


def _text(page: tuple[float, float], x: float, y: float, text: str) -> str:
    escaped = text.replace("\\", r"\\").replace("(", r"\(").replace(")", r"\)")
    place = f"{x * _POINTS_PER_MM:.3f} {(page[1] - y) * _POINTS_PER_MM:.3f} Td"
    return f"BT /F1 {_TEXT_MM * _POINTS_PER_MM:.3f} Tf {place} ({escaped}) Tj ET"


def _pdf(page: tuple[float, float], drawn: Sequence[str]) -> bytes:
    """Return the file: five objects, the table of their positions, and the trailer."""
    content = "\n".join([_INK, *drawn]).encode("latin-1", "replace")
    width, height = (side * _POINTS_PER_MM for side in page)
    objects = [
        b"<< /Type /Catalog /Pages 2 0 R /ViewerPreferences << /PrintScaling /None >> >>",
        b"<< /Type /Pages /Kids [3 0 R] /Count 1 >>",
        (
            f"<< /Type /Page /Parent 2 0 R /MediaBox [0 0 {width:.4f} {height:.4f}] /Contents 5 0 R "
            "/Resources << /Font << /F1 4 0 R >> >> >>"
        ).encode(),
        b"<< /Type /Font /Subtype /Type1 /BaseFont /Helvetica /Encoding /WinAnsiEncoding >>",
        b"<< /Length %d >>\nstream\n%b\nendstream" % (len(content), content),
    ]
    data, places = b"%PDF-1.4\n", []
    for number, text in enumerate(objects, start=1):
        places.append(len(data))
        data += b"%d 0 obj\n%b\nendobj\n" % (number, text)
    table = b"".join(b"%010d 00000 n \n" % place for place in places)
    count = len(objects) + 1
    end = b"trailer\n<< /Size %d /Root 1 0 R >>\nstartxref\n%d\n%%%%EOF\n" % (count, len(data))
    return data + b"xref\n0 %d\n0000000000 65535 f \n" % count + table + end
