"""Camera models and their parameters by name, as files state them and as fits change them."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, Final

import numpy as np

from calib.errors import CalibError
from calib.models.camera import Mask, OmniCamera
from calib.models.lens import DoubleSphereCamera, EquidistantCamera, EquirectangularCamera
from calib.models.ocam import ASTIGMATISM_NAMES, DISTANCE_M, TANGENTIAL_NAMES, OcamCamera, View
from calib.models.unified import DISTORTION_NAMES, UnifiedCamera
from calib.models.wavefront import WAVEFRONT_NAMES

_PLANE: Final = {"focal": ("fu", "fv"), "center": ("pu", "pv")}
# For each model: its class, and for each field the names of its numbers, in the order of files. The polynomial of an
# ocam camera (a0, a1 ...) comes before them.
MODELS: Final[Mapping[str, tuple[type[Any], Mapping[str, tuple[str, ...]]]]] = MappingProxyType(
    {
        "omni": (UnifiedCamera, {"xi": ("xi",), **_PLANE, "distortion": DISTORTION_NAMES}),
        "ocam": (
            OcamCamera,
            {
                "center_row_column": ("center_row", "center_column"),
                "affine": ("c", "d", "e"),
                "tangential": TANGENTIAL_NAMES,
                "astigmatism": ASTIGMATISM_NAMES,
                "wavefront": WAVEFRONT_NAMES,
            },
        ),
        "ds": (DoubleSphereCamera, {"xi": ("xi",), "alpha": ("alpha",), **_PLANE}),
        "equidistant": (EquidistantCamera, {"coefficients": ("k1", "k2", "k3", "k4"), **_PLANE}),
        "equirectangular": (EquirectangularCamera, _PLANE),
    }
)
# Fields whose numbers are 0 by default.
OPTIONAL: Final = ("distortion", "coefficients", "tangential", "astigmatism", "wavefront")


def names_of(model: str) -> tuple[str, ...]:
    """Return the names of a model's parameters in the order of files, without those of a polynomial."""
    return tuple(name for names in MODELS[model][1].values() for name in names)


def model_name(camera: OmniCamera) -> str:
    """Return the name of a camera's model, as the key `model` of files; CalibError for a camera of no known model."""
    for model, (kind, _) in MODELS.items():
        if type(camera) is kind:
            return model
    raise CalibError(f"expected a camera of a known model, found {type(camera).__name__}")


def values_of(camera: OmniCamera) -> dict[str, float]:
    """Return all parameters of a camera by name, in the order of files; CalibError for a camera of no known model."""
    polynomial = camera.polynomial if isinstance(camera, OcamCamera) else ()
    values = {f"a{power}": value for power, value in enumerate(polynomial)}
    for field, names in MODELS[model_name(camera)][1].items():
        values |= zip(names, np.ravel(getattr(camera, field)).tolist(), strict=True)
    return values


def camera_of(
    model: str,
    values: Mapping[str, float],
    size: tuple[int, int],
    view: View = "mirror",
    distance_m: float = DISTANCE_M,
) -> OmniCamera:
    """Return the camera of a model with these parameters; the fields in OPTIONAL may be missing.

    size (width, height) [px]; view and distance_m: of an ocam camera. Raise CalibError for values of no camera, and
    KeyError for a missing one.
    """
    kind, parts = MODELS[model]
    fields = dict[str, Any](size=size)
    for field, names in parts.items():
        numbers = tuple(float(values.get(name, 0.0) if field in OPTIONAL else values[name]) for name in names)
        fields[field] = numbers[0] if names == (field,) else numbers
    if kind is OcamCamera:
        degree = max(int(name[1:]) for name in values if is_coefficient(name))
        polynomial = tuple(float(values.get(f"a{power}", 0.0)) for power in range(degree + 1))
        fields |= {"polynomial": polynomial, "view": view, "distance_m": distance_m}
    camera: OmniCamera = kind(**fields)
    return camera


def changed(camera: OmniCamera, changes: Mapping[str, float]) -> OmniCamera:
    """Return the camera with parameters changed by these amounts; CalibError for an unknown name or an invalid result.

    d of an ocam camera moves d and e together, because their difference is a rotation of the camera.
    """
    values = values_of(camera)
    for name, change in changes.items():
        if name not in values and not (isinstance(camera, OcamCamera) and is_coefficient(name)):
            raise CalibError(f"a camera of the model {model_name(camera)} has no parameter {name!r}")
        values[name] = values.get(name, 0.0) + change
        if name == "d" and isinstance(camera, OcamCamera):
            values["e"] += change
    if isinstance(camera, OcamCamera):
        return camera_of("ocam", values, camera.size, camera.view, camera.distance_m)
    return camera_of(model_name(camera), values, camera.size)


def is_coefficient(name: str) -> bool:
    """True for the name of a coefficient of a polynomial, like a2."""
    return name[0] == "a" and name[1:].isdigit()


def model_in_words(camera: OmniCamera) -> str:
    """Return the name of a camera's model, for ocam cameras with their view."""
    return f"ocam, {camera.view} view" if isinstance(camera, OcamCamera) else model_name(camera)


def sees_directly(camera: OmniCamera) -> bool:
    """True for a camera without a mirror: its image has no hub and need not have a rim."""
    if isinstance(camera, OcamCamera):
        return camera.view == "direct"
    if isinstance(camera, UnifiedCamera):
        return camera.xi == 0 or camera.focal[0] * camera.focal[1] > 0  # a mirror flips its image
    return True


def visible_part(camera: OmniCamera) -> Mask:
    """Return the mask if none is known: a disc about the whole image of a lens, the largest one in that of a mirror."""
    (u, v), (width, height) = camera.center, camera.size
    if sees_directly(camera):
        return Mask((u, v), 0.0, float(np.hypot(max(u, width - 1 - u), max(v, height - 1 - v))) + 1.0)
    return Mask((u, v), 0.0, max(0.0, min(u, v, width - 1 - u, height - 1 - v)))
