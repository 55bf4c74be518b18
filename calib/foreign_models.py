"""Camera models of other programs as cameras of omnid, by one table of their names; exact where the model exists here.

Kalibr, EuRoC and ROS name a projection and a distortion; OpenCV's many distortion terms (k3 and more) and the fov model
have no equal here: the nearest camera is fitted over the image, and its largest error is reported.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Final

import cv2
import numpy as np
import scipy.optimize

from calib.errors import CalibError
from calib.models.camera import Array, OmniCamera
from calib.models.names import camera_of as known_camera
from calib.models.names import changed, model_name, values_of
from calib.validation import Warn, require_image_size, silent

FOCAL: Final = ("fu", "fv", "pu", "pv")
RADTAN: Final = ("k1", "k2", "p1", "p2")
EQUIDISTANT: Final = ("k1", "k2", "k3", "k4")
# OpenCV's order, of which a file may give the first 4, 5, 8, 12 or 14.
OPENCV: Final = (*RADTAN, "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4", "tx", "ty")
# By the names of projection and distortion: the model, its intrinsics and its distortion terms, in the files' order.
MODELS: Final[Mapping[tuple[str, str], tuple[str, tuple[str, ...], tuple[str, ...]]]] = {
    ("omni", "radtan"): ("omni", ("xi", *FOCAL), RADTAN),
    ("omni", "none"): ("omni", ("xi", *FOCAL), ()),
    ("pinhole", "radtan"): ("pinhole", FOCAL, RADTAN),
    ("pinhole", "opencv"): ("pinhole", FOCAL, OPENCV),
    ("pinhole", "none"): ("pinhole", FOCAL, ()),
    ("pinhole", "equidistant"): ("equidistant", FOCAL, EQUIDISTANT),
    ("pinhole", "fov"): ("fov", FOCAL, ("w",)),
    ("ds", "none"): ("ds", ("xi", "alpha", *FOCAL), ()),
    ("eucm", "none"): ("eucm", ("alpha", "beta", *FOCAL), ()),
}
# Other names of the distortions: those of Kalibr's command line, EuRoC, ROS and OpenCV.
DISTORTIONS: Final[Mapping[str, str]] = {
    "": "none",
    "equi": "equidistant",
    "fisheye": "equidistant",
    "radial-tangential": "radtan",
    "plumb_bob": "opencv",
    "rational_polynomial": "opencv",
}
# Models whose files name each number: those of basalt, then those of camodocal, with their names for ours.
PINHOLE_KEYS: Final = {"fx": "fu", "fy": "fv", "cx": "pu", "cy": "pv"}
NAMED: Final[Mapping[str, tuple[str, Mapping[str, str]]]] = {
    **{model: (model, PINHOLE_KEYS) for model in ("ds", "eucm", "ucm", "pinhole", "fov")},
    "kb4": ("equidistant", PINHOLE_KEYS),
    "pinhole-radtan8": ("pinhole", PINHOLE_KEYS),
    "PINHOLE": ("pinhole", PINHOLE_KEYS),
    "MEI": ("omni", {"gamma1": "fu", "gamma2": "fv", "u0": "pu", "v0": "pv"}),
    "KANNALA_BRANDT": (
        "equidistant",
        {"k2": "k1", "k3": "k2", "k4": "k3", "k5": "k4", "mu": "fu", "mv": "fv", "u0": "pu", "v0": "pv"},
    ),
}
# A camera that is fitted to another model may be this far off anywhere in the image, a few times the error of a corner.
MAX_CONVERSION_PX: Final = 0.5
GRID: Final = 24  # Places along each side of the image at which models are compared.
# Largest angle from the axis, and number of angles up to it, at which a distortion is tested for turning back.
WIDEST_RAD, RADII = np.deg2rad(85), 2000
LOST_PX: Final = 100.0  # Error of a ray that a trial camera does not see.


def camera_of_lists(
    names: tuple[str, str],
    intrinsics: Sequence[float],
    terms: Sequence[float],
    size: tuple[int, int],
    warn: Warn = silent,
) -> OmniCamera:
    """Return the camera of the named projection and distortion. Errors begin with the key that is wrong."""
    projection, distortion = (name.lower() for name in names)
    if not distortion and "-" in projection:  # as on Kalibr's command line
        projection, _, distortion = projection.partition("-")
    distortion = DISTORTIONS.get(distortion, distortion)
    known = [found for found in MODELS if found[0] == projection]
    if not known:
        projections = " or ".join(dict.fromkeys(found[0] for found in MODELS))
        raise CalibError(f"camera_model: expected {projections}, found {names[0]!r}: calibrate with one of them")
    if (projection, distortion) not in MODELS:
        found = " or ".join(found[1] for found in known)
        raise CalibError(f"distortion_model: expected {found}, found {distortion!r}: calibrate with one of them")
    model, keys, term_keys = MODELS[projection, distortion]
    if len(intrinsics) != len(keys):
        raise CalibError(f"intrinsics: expected {len(keys)} numbers ({' '.join(keys)}), found {len(intrinsics)}")
    if distortion == "none":
        terms = ()
    right_counts = (0, 4, 5, 8, 12, 14) if distortion == "opencv" else (len(term_keys),)
    if len(terms) not in right_counts:
        expected = " or ".join(map(str, right_counts))
        raise CalibError(f"distortion_coeffs: expected {expected} numbers, found {len(terms)}")
    return camera_of(model, dict(zip((*keys, *term_keys), (*intrinsics, *terms), strict=False)), size, warn)


def camera_of_names(
    key: str, kind: str, numbers: Mapping[str, float], size: tuple[int, int], warn: Warn = silent
) -> OmniCamera:
    """Return the camera of a model of NAMED, whose name is under a key of the file, with named numbers."""
    if kind not in NAMED:
        raise CalibError(f"{key}: expected {', '.join(NAMED)}, found {kind!r}")
    model, names = NAMED[kind]
    try:
        return camera_of(model, {names.get(name, name): value for name, value in numbers.items()}, size, warn)
    except KeyError as error:
        raise CalibError(f"{kind}: expected the number {error} of its model") from error


def camera_of(model: str, values: Mapping[str, float], size: tuple[int, int], warn: Warn = silent) -> OmniCamera:
    """Return the camera of a model with named values; `warn` takes a line if the camera had to be fitted."""
    require_image_size("resolution", *size)
    pinhole = {key: float(values[key]) for key in FOCAL}
    plain = {**pinhole, "xi": 0.0, **{key: values[key] for key in RADTAN if key in values}}
    if model == "ucm":  # the extended model with beta = 1
        return known_camera("eucm", {**values, "beta": 1.0}, size)
    if model == "fov":
        return _nearest(model, known_camera("equidistant", pinhole, size), _seen(_fov_project, values, size), warn)
    if model != "pinhole":
        return known_camera(model, values, size)
    start = known_camera("omni", plain, size)
    if not any(values.get(key, 0.0) for key in OPENCV if key not in RADTAN):
        return start
    return _nearest("pinhole with k3 and more", start, _seen(_opencv_project, values, size), warn)


def _fov_project(m: Array, values: Mapping[str, float]) -> Array:
    """Return the pixels (N, 2) of points (N, 2) of the plane z = 1 by the model fov: r_d = atan(2 r_u tan(w / 2)) / w.

    Devernay and Faugeras 2001.
    """
    w = float(values["w"])
    if not 0 < w < np.pi:
        raise CalibError(f"fov camera: expected w between 0 and pi, found {w}")
    radius = np.maximum(np.linalg.norm(m, axis=1, keepdims=True), np.finfo(float).tiny)
    bent = m * np.arctan(2 * radius * np.tan(w / 2)) / (w * radius)
    return np.asarray(bent * (values["fu"], values["fv"]) + (values["pu"], values["pv"]))


def _opencv_project(m: Array, values: Mapping[str, float]) -> Array:
    """Return the pixels (N, 2) of points (N, 2) of the plane z = 1 by OpenCV's distortion."""
    K = np.array([[values["fu"], 0, values["pu"]], [0, values["fv"], values["pv"]], [0, 0, 1.0]])
    rays, terms = np.column_stack([m, np.ones(len(m))]), np.array([values.get(key, 0.0) for key in OPENCV], float)
    return np.asarray(cv2.projectPoints(rays, np.zeros(3), np.zeros(3), K, terms)[0].reshape(-1, 2))


def _seen(
    project: Callable[[Array, Mapping[str, float]], Array], values: Mapping[str, float], size: tuple[int, int]
) -> tuple[Array, Array]:
    """Return pixels (N, 2), evenly spread over the part of the image with rays, and their rays (N, 3)."""
    center = (values["pu"], values["pv"])
    found_pixels, found_rays = list[Array](), list[Array]()
    for azimuth in np.linspace(0, 2 * np.pi, 2 * GRID, endpoint=False):
        direction = np.array([np.cos(azimuth), np.sin(azimuth)])
        # 1. Outwards as far as the pixels go outwards within the image: where the distortion turns back, rays end.
        rho = np.tan(np.linspace(0, WIDEST_RAD, RADII))
        radius = np.linalg.norm(project(rho[:, None] * direction, values) - center, axis=1)
        ended = np.flatnonzero((np.diff(radius) <= 0) | (radius[1:] > np.hypot(*size)))
        end = int(ended[0]) + 1 if ended.size else RADII
        # 2. Rays of evenly spaced pixels.
        even = np.interp(np.linspace(0, radius[end - 1], 4 * GRID), radius[:end], rho[:end])
        pixels = project(even[:, None] * direction, values)
        inside = ((pixels >= 0) & (pixels <= np.array(size) - 1)).all(axis=1)
        found_pixels.append(pixels[inside])
        found_rays.append(np.column_stack([even[inside, None] * direction, np.ones(inside.sum())]))
    return np.concatenate(found_pixels), np.concatenate(found_rays)


def _nearest(name: str, start: OmniCamera, rays: tuple[Array, Array], warn: Warn) -> OmniCamera:
    """Fit a camera to rays (N, 3) and pixels (N, 2), from a start; CalibError if the largest error is too large."""
    pixels, directions = rays
    if len(pixels) < GRID:
        raise CalibError(f"{name}: it sees too little of its image: calibrate with pinhole-equi or ds")
    first = values_of(start)

    def make(values: Array) -> OmniCamera:
        return changed(start, dict(zip(first, (values - [*first.values()]).tolist(), strict=True)))

    def errors(values: Array) -> Array:
        try:
            off = make(values).project(directions) - pixels
        except CalibError:
            off = np.full(pixels.shape, LOST_PX)
        return np.clip(np.nan_to_num(off, nan=LOST_PX), -LOST_PX, LOST_PX).ravel()

    found = scipy.optimize.least_squares(errors, [*first.values()], x_scale="jac", method="trf", max_nfev=200).x
    camera, off = make(found), np.linalg.norm(errors(found).reshape(-1, 2), axis=1)
    rms_px, most_px = float(np.sqrt((off**2).mean())), float(off.max())
    if most_px > MAX_CONVERSION_PX:
        raise CalibError(
            f"{name} camera: the nearest {model_name(camera)} camera is up to {most_px:.2g} px off: calibrate with "
            "Kalibr's omni-radtan, pinhole-equi, ds or eucm"
        )
    warn(
        f"{name} is read as the nearest {model_name(camera)} camera, off by {rms_px:.2g} px rms, {most_px:.2g} px at "
        "most"
    )
    return camera
