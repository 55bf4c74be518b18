"""OCamCalib's `calib_results.txt`, read and written: one file per camera, without the transform between them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import NoReturn

import numpy as np

from calib.errors import CalibError
from calib.models.camera import Array, OmniCamera
from calib.models.names import model_name
from calib.models.ocam import MAX_COEFFICIENTS, OcamCamera, View
from calib.rig import Rig
from calib.rig_frame import rig_between
from calib.validation import MAX_PIXELS, MAX_SIDE_PX, decode, is_image_size, read_bytes, shown

# More than any file needs: one of the toolbox has about 2 kB.
MAX_BYTES = 1 << 16
# The degree of the inverse polynomial is raised until it reaches this error, because that is the toolbox's own goal and
# bound.
INVERSE_GOAL_PX = 0.01
INVERSE_DEGREES = range(4, 26)


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


def export_ocam(camera: OmniCamera) -> str:
    """Return the text of a calib_results.txt, with an inverse polynomial for programs that need one."""
    if not isinstance(camera, OcamCamera):
        raise CalibError(
            f"export: calib_results.txt holds ocam cameras, found one of the model {model_name(camera)}; "
            "use --format kalibr for an omni camera"
        )
    if any(camera.tangential) or any(camera.astigmatism) or any(camera.wavefront):
        raise CalibError(
            "export: calib_results.txt cannot hold the terms p1, p2, s1, s2, wavefront of this camera; "
            "calibrate with --model ocam"
        )
    width, height = camera.size
    sections = (
        ("polynomial coefficients for the direct mapping: f(rho), constant first", _counted(camera.polynomial)),
        (
            "polynomial coefficients for the inverse mapping: rho of the angle, constant first",
            _counted(inverse_polynomial(camera)),
        ),
        ('center: "row" and "column", starting from 0 (C convention)', _row(camera.center_row_column)),
        ('affine parameters "c", "d", "e"', _row(camera.affine)),
        ('image size: "height" and "width"', f"{int(height)} {int(width)}"),
    )
    return "".join(f"#{title}\n\n{numbers}\n\n" for title, numbers in sections)


def inverse_polynomial(camera: OcamCamera) -> tuple[float, ...]:
    """Fit rho [px] as a polynomial of atan(f(rho)/rho) [rad] over the radii of the image, as in the toolbox's files."""
    corners = np.hypot(*(np.maximum(camera.center, np.subtract(camera.size, camera.center))))
    radii = np.linspace(0, min(float(corners), camera.radius_limit_px), 1000)
    angles = np.arctan2(camera.height(radii), radii)
    for degree in INVERSE_DEGREES:
        fit = np.polynomial.Polynomial.fit(angles, radii, degree)
        if np.abs(fit(angles) - radii).max() < INVERSE_GOAL_PX:
            break
    return tuple(float(a) for a in fit.convert().coef)


def _counted(values: tuple[float, ...]) -> str:
    return f"{len(values)} {_row(values)}"


def _row(values: tuple[float, ...]) -> str:
    return " ".join(repr(float(value) + 0.0) for value in values)
