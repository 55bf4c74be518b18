"""One camera as text: `camera.toml`, whose [camera] table is that of a rig.toml without its place on the rig."""

from __future__ import annotations

import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from calib import rig_file
from calib.camera import Mask, OmniCamera
from calib.errors import CalibError
from calib.strict import Table, decode, read_bytes

SCHEMA = 1
Parameter = tuple[str, float, float]  # name, value, standard deviation


@dataclass(frozen=True, slots=True)
class CameraFile:
    """A camera and what it shows of the world; mask None where nobody has measured it."""

    camera: OmniCamera
    mask: Mask | None = None


@dataclass(frozen=True, slots=True)
class Quality:
    """How well a camera is known: mean reprojection error [px], number of views, the parameters' deviations."""

    mean_error_px: float
    views: int
    parameters: Sequence[Parameter]


def read_camera(path: Path) -> CameraFile:
    """The camera in a `camera.toml`; its mask's picture is looked for beside it."""
    return parse_camera(read_bytes(path), path.parent, str(path))


def parse_camera(text: str | bytes, folder: Path | None = None, name: str = "camera.toml") -> CameraFile:
    """The camera in the text of a `camera.toml`; folder holds its mask's picture."""
    try:
        values = tomllib.loads(decode(text, name))
    except (tomllib.TOMLDecodeError, RecursionError, ValueError) as error:
        raise CalibError(f"{name}: not a TOML file: {error}") from error
    table = Table(values, name)
    if type(values.get("schema")) is not int or values["schema"] != SCHEMA:
        table.fail("schema", f"version {SCHEMA}")
    table.only(("schema", "camera", "quality"))
    camera = table.table("camera")
    model = camera.choice("model", ("omni", "ocam"))
    camera.only(("model", "size", "topic", "intrinsics", "mask", *(["view"] if model == "ocam" else [])))
    read = rig_file._omni if model == "omni" else rig_file._ocam
    return CameraFile(read(camera), rig_file._mask(camera, folder) if camera.has("mask") else None)


def camera_toml(file: CameraFile, quality: Quality | None = None, mask_image: str = "") -> str:
    """The text of a `camera.toml`; mask_image names the mask's picture, "" embeds it."""
    parts = [f"schema = {SCHEMA}\n", rig_file._camera_text("camera", file.camera, ""),
             rig_file._intrinsics_text("camera", file.camera)]
    if file.mask is not None:
        parts.append(rig_file._mask_text("camera", file.mask, mask_image))
    if quality is not None:
        parts.append(_quality_text(quality))
    return "".join(parts)


def _quality_text(quality: Quality) -> str:
    lines = ["", "[quality]", f"mean_error_px = {round(quality.mean_error_px, 6)}", f"views = {quality.views}", "",
             "[quality.deviations]"]
    lines += [f"{rig_file._string(name)} = {deviation:.6g}" for name, _, deviation in quality.parameters]
    return "\n".join(lines) + "\n"
