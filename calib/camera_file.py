"""One camera as text: `camera.toml`, whose [camera] table is that of a rig.toml without the pose on the rig."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from calib.camera_table import camera_text, intrinsics_text, mask_text, read_camera_table, string_text
from calib.models.camera import Mask, OmniCamera
from calib.validation import read_bytes, require_schema, toml_table

SCHEMA = 1  # the first: it rises when an earlier program would misread the file
# Name, value, standard deviation.
Parameter = tuple[str, float, float]


@dataclass(frozen=True, slots=True)
class CameraFile:
    """A camera and the mask of its image; mask None if it was not measured."""

    camera: OmniCamera
    mask: Mask | None = None


@dataclass(frozen=True, slots=True)
class Quality:
    """Quality of a calibration: mean reprojection error [px], number of views, parameters with sigmas."""

    mean_error_px: float
    views: int
    parameters: Sequence[Parameter]


def read_camera(path: Path) -> CameraFile:
    """Read the camera of a `camera.toml`; its mask's image is read from the same folder."""
    return parse_camera(read_bytes(path), path.parent, str(path))


def parse_camera(text: str | bytes, folder: Path | None = None, name: str = "camera.toml") -> CameraFile:
    """Parse the camera of a `camera.toml`'s text; folder contains its mask's image."""
    table = toml_table(text, name)
    require_schema(table, SCHEMA)
    table.allow_only(("schema", "camera", "quality"))
    return CameraFile(*read_camera_table(table.table("camera"), folder))


def camera_toml(file: CameraFile, quality: Quality | None = None, mask_image: str = "") -> str:
    """Return the text of a `camera.toml`; mask_image is the file name of the mask's image, "" embeds it."""
    parts = [f"schema = {SCHEMA}\n", camera_text("camera", file.camera, ""), intrinsics_text("camera", file.camera)]
    if file.mask is not None:
        parts.append(mask_text("camera", file.mask, mask_image))
    if quality is not None:
        parts.append(_quality_text(quality))
    return "".join(parts)


def _quality_text(quality: Quality) -> str:
    lines = [
        "",
        "[quality]",
        f"mean_error_px = {round(quality.mean_error_px, 6)}",
        f"views = {quality.views}",
        "",
        "[quality.standard_deviations]",
    ]
    lines += [f"{string_text(name)} = {sigma:.6g}" for name, _, sigma in quality.parameters]
    return "\n".join(lines) + "\n"
