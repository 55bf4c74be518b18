"""OCamCalib's `calib_results.txt`: one file per camera. The transform between them has a file, or is straight up."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from msgspec import Struct

from calib import se3
from calib.errors import CalibError
from calib.models.camera import Array
from calib.models.ocam import MAX_COEFFICIENTS, OcamCamera, View
from calib.rig import MIN_BASELINE_M
from calib.text_files import decode, load_mapping
from calib.typed_toml import convert, shown, table_of
from calib.validation import MAX_PIXELS, MAX_SIDE_PX, is_image_size, read_bytes, transform_of

# More than any file needs: one of the toolbox has about 2 kB.
MAX_BYTES = 1 << 16


KEY, INVERSE_KEY = "T_lower_upper", "T_upper_lower"


class TransformTable(Struct, frozen=True):
    """A file with the transform between two cameras."""

    T_lower_upper: tuple[tuple[float, ...], ...] | None = None
    T_upper_lower: tuple[tuple[float, ...], ...] | None = None


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


def parse_ocam(text: str | bytes, view: View = "mirror", name: str = "calib_results.txt") -> OcamCamera:
    """Parse the camera of a calib_results.txt's text; the inverse polynomial, of any length, is not used."""
    if len(text) > MAX_BYTES:
        raise CalibError(f"{name}: expected at most {MAX_BYTES} bytes, found {len(text)}")
    lines = _lines(text, name)
    if len(lines) < 4:
        raise CalibError(
            f"{name}: expected lines of numbers (polynomial, inverse polynomial, centre, affine, image size), found "
            f"{len(lines)}"
        )
    polynomial = lines[0].counted("polynomial coefficients")
    row, column = lines[-3].numbers("row and column of the centre", 2)
    c, d, e = lines[-2].numbers("affine c d e", 3)
    size = _size(lines[-1])
    try:
        return OcamCamera(polynomial, (row, column), (c, d, e), size, view)
    except CalibError as error:
        raise CalibError(f"{name}: {error}") from error


def is_ocam(text: str | bytes, name: str) -> bool:
    """True for a text whose first line that is no comment is a count and numbers."""
    return next((line.words[0].isdigit() and len(line.words) > 1 for line in _lines(text, name)), False)


def _lines(text: str | bytes, name: str) -> list[_Line]:
    """Return the lines of numbers, without comments (# here, % in MATLAB) and commas."""
    found = [
        _Line(number, re.split(r"[#%]", line, maxsplit=1)[0].replace(",", " ").split(), name)
        for number, line in enumerate(decode(text, name).splitlines(), 1)
    ]
    return [line for line in found if line.words]


def _size(line: _Line) -> tuple[int, int]:
    height, width = line.numbers("height and width of the image", 2)
    if not is_image_size(width, height) or (height, width) != (int(height), int(width)):
        line.fail(f"the image's height and width in whole pixels, 1 to {MAX_SIDE_PX}, at most {MAX_PIXELS} in all")
    return int(width), int(height)


def read_transform(path: Path) -> Array:
    """Read T_lower_upper (4, 4): TOML or YAML with that key (or T_upper_lower), or a text of its 16 numbers."""
    data, name = read_bytes(path, MAX_BYTES), str(path)
    try:
        if path.suffix == ".toml":
            return _named(table_of(data))
        if path.suffix in (".yaml", ".yml", ".json"):
            return _named(dict(load_mapping(data, name)))
        words = [word for line in _lines(data, name) for word in line.words]
        try:
            numbers = [float(word) for word in words]
        except ValueError as error:
            raise CalibError(f"expected 16 numbers, the rows of {KEY}: {error}") from error
        if not np.isfinite(numbers).all():
            raise CalibError(f"{KEY}: expected 16 finite numbers")
        return transform_of([numbers[start : start + 4] for start in range(0, len(numbers), 4)], KEY)
    except (CalibError, ValueError) as error:
        raise error if str(error).startswith(f"{name}: ") else CalibError(f"{name}: {error}") from error


def _named(values: dict[str, Any]) -> Array:
    """Return the transform of a file with its name."""
    found = convert(TransformTable, values)
    if (found.T_lower_upper is None) == (found.T_upper_lower is None):
        raise CalibError(f"expected either {KEY} or {INVERSE_KEY}")
    if found.T_lower_upper is not None:
        return transform_of(found.T_lower_upper, KEY)
    return se3.inverse(transform_of(found.T_upper_lower, INVERSE_KEY))


def straight_up(baseline_m: float) -> Array:
    """Return T_lower_upper of an upper camera straight above the lower one, equally oriented, both looking up.

    A lens that looks up, and a camera that looks up into its mirror, both have their z axis pointing down.
    """
    if not (np.isfinite(baseline_m) and baseline_m >= MIN_BASELINE_M):
        raise CalibError(f"--baseline: expected metres, {MIN_BASELINE_M} or more, found {baseline_m}")
    return se3.transform(np.eye(3), (0.0, 0.0, -baseline_m))
