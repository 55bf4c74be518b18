"""OCamCalib's `calib_results.txt`: one file per camera, without the transform between them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import NoReturn

import numpy as np

from calib.errors import CalibError
from calib.models.camera import Array
from calib.models.ocam import MAX_COEFFICIENTS, OcamCamera, View
from calib.rig import Rig
from calib.rig_frame import rig_between
from calib.validation import MAX_PIXELS, MAX_SIDE_PX, decode, is_image_size, read_bytes, shown

# More than any file needs: one of the toolbox has about 2 kB.
MAX_BYTES = 1 << 16


@dataclass(frozen=True, slots=True)
class _Line:
    """One line of numbers and its position in the file."""

    number: int
    words: list[str]
    file: str

    def fail(self, expected: str) -> NoReturn:
        raise CalibError(f"{self.file}, line {self.number}: expected {expected}, found {shown(' '.join(self.words))}")

    def numbers(self, what: str, count: int) -> tuple[float, ...]:
        try:
            values = tuple(float(word) for word in self.words)
        except ValueError:
            values = ()
        if len(values) != count or not np.isfinite(values).all():
            self.fail(f"{count} finite numbers ({what})")
        return values

    def counted(self, what: str) -> tuple[float, ...]:
        """Return the numbers of a line that starts with their count."""
        lead = self.words[0]
        count = int(lead) if lead.isascii() and lead.isdigit() and len(lead) < 4 else 0
        if not 1 <= count <= MAX_COEFFICIENTS:
            self.fail(f"a count of 1 to {MAX_COEFFICIENTS}, then that number of {what}")
        return self.numbers(f"a count and {what}", count + 1)[1:]


def import_ocam(lower_path: Path, upper_path: Path, T_lower_upper: Array, view: View = "mirror") -> Rig:
    """Read the rig of two calib_results.txt; its frame is the lower viewpoint's, see rig_between."""
    lower, upper = (parse_ocam(read_bytes(path, MAX_BYTES), view, str(path)) for path in (lower_path, upper_path))
    return rig_between(lower, upper, T_lower_upper)


def parse_ocam(text: str | bytes, view: View = "mirror", name: str = "calib_results.txt") -> OcamCamera:
    """Parse the camera of a calib_results.txt's text; the inverse polynomial is checked and not used."""
    if len(text) > MAX_BYTES:
        raise CalibError(f"{name}: expected at most {MAX_BYTES} bytes, found {len(text)}")
    lines = [
        _Line(number, line.split(), name)
        for number, line in enumerate(decode(text, name).splitlines(), 1)
        if line.strip() and not line.lstrip().startswith("#")
    ]
    if len(lines) != 5:
        raise CalibError(
            f"{name}: expected 5 lines of numbers (polynomial, inverse polynomial, centre, affine, image "
            f"size), found {len(lines)}"
        )
    polynomial = lines[0].counted("polynomial coefficients")
    lines[1].counted("inverse polynomial coefficients")
    row, column = lines[2].numbers("row and column of the centre", 2)
    c, d, e = lines[3].numbers("affine c d e", 3)
    size = _size(lines[4])
    try:
        return OcamCamera(polynomial, (row, column), (c, d, e), size, view)
    except CalibError as error:
        raise CalibError(f"{name}: {error}") from error


def _size(line: _Line) -> tuple[int, int]:
    height, width = line.numbers("height and width of the image", 2)
    if not is_image_size(width, height) or (height, width) != (int(height), int(width)):
        line.fail(f"the image's height and width in whole pixels, 1 to {MAX_SIDE_PX}, at most {MAX_PIXELS} in all")
    return int(width), int(height)
