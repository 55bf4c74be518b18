"""Camera models by their names, and their parameters by name: as files state them and as fits change them."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

from calib.errors import CalibError
from calib.models.camera import Mask, OmniCamera, inscribed_mask, whole_image
from calib.models.equirectangular import EquirectangularCamera
from calib.models.lens import DoubleSphereCamera, EquidistantCamera, ExtendedUnifiedCamera
from calib.models.ocam import ASTIGMATISM_NAMES, DISTANCE_M, TANGENTIAL_NAMES, OcamCamera, View
from calib.models.unified import OMNI_NAMES, UnifiedCamera
from calib.models.wavefront import WAVEFRONT_NAMES

PINHOLE_NAMES = ("fu", "fv", "pu", "pv")
# Parameters of the models in the order of files. Those of an ocam camera: a0, a1 ... of its polynomial, then these.
NAMES: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {
        "omni": OMNI_NAMES,
        "ds": ("xi", "alpha", *PINHOLE_NAMES),
        "eucm": ("alpha", "beta", *PINHOLE_NAMES),
        "equidistant": ("k1", "k2", "k3", "k4", *PINHOLE_NAMES),
        "equirectangular": PINHOLE_NAMES,
    }
)
MODELS: Mapping[type, str] = MappingProxyType(
    {
        UnifiedCamera: "omni",
        OcamCamera: "ocam",
        DoubleSphereCamera: "ds",
        ExtendedUnifiedCamera: "eucm",
        EquidistantCamera: "equidistant",
        EquirectangularCamera: "equirectangular",
    }
)
LENSES = (DoubleSphereCamera, ExtendedUnifiedCamera, EquidistantCamera, EquirectangularCamera)
OCAM_NAMES = ("center_row", "center_column", "c", "d", "e", *TANGENTIAL_NAMES, *ASTIGMATISM_NAMES, *WAVEFRONT_NAMES)


def model_name(camera: OmniCamera) -> str:
    """Return the name of a camera's model, as the key `model` of files; CalibError for a camera of no known model."""
    if type(camera) not in MODELS:
        raise CalibError(f"expected a camera of a known model, found {type(camera).__name__}")
    return MODELS[type(camera)]


def values_of(camera: OmniCamera) -> dict[str, float]:
    """Return all parameters of a camera by name, in the order of files; CalibError for a camera of no known model."""
    if isinstance(camera, OcamCamera):
        polynomial = {f"a{power}": value for power, value in enumerate(camera.polynomial)}
        others = (*camera.center_row_column, *camera.affine, *camera.tangential, *camera.astigmatism, *camera.wavefront)
        return polynomial | dict(zip(OCAM_NAMES, others, strict=True))
    own: tuple[float, ...] = ()
    if isinstance(camera, UnifiedCamera):
        return dict(zip(OMNI_NAMES, (camera.xi, *camera.focal, *camera.center, *camera.distortion), strict=True))
    if isinstance(camera, DoubleSphereCamera):
        own = (camera.xi, camera.alpha)
    elif isinstance(camera, ExtendedUnifiedCamera):
        own = (camera.alpha, camera.beta)
    elif isinstance(camera, EquidistantCamera):
        own = camera.coefficients
    names = NAMES[model_name(camera)]
    assert isinstance(camera, LENSES)
    return dict(zip(names, (*own, *camera.focal, *camera.center), strict=True))


def camera_of(
    model: str,
    values: Mapping[str, float],
    size: tuple[int, int],
    view: View = "mirror",
    distance_m: float = DISTANCE_M,
) -> OmniCamera:
    """Return the camera of a model with these parameters; those of distortions and of real mirrors may be missing.

    size (width, height) [px]; view and distance_m: of an ocam camera. Raise CalibError for values of no camera.
    """
    v = {name: float(value) for name, value in values.items()}
    if model == "ocam":
        degree = max(int(name[1:]) for name in v if is_coefficient(name))
        s1, s2, p1, p2 = (v.get(name, 0.0) for name in (*ASTIGMATISM_NAMES, *TANGENTIAL_NAMES))
        return OcamCamera(
            tuple(v.get(f"a{power}", 0.0) for power in range(degree + 1)),
            (v["center_row"], v["center_column"]),
            (v["c"], v["d"], v["e"]),
            size,
            view,
            (p1, p2),
            (s1, s2),
            tuple(v.get(name, 0.0) for name in WAVEFRONT_NAMES),
            distance_m,
        )
    focal, center = (v["fu"], v["fv"]), (v["pu"], v["pv"])
    k1, k2, k3, k4, p1, p2 = (v.get(name, 0.0) for name in ("k1", "k2", "k3", "k4", "p1", "p2"))
    match model:
        case "omni":
            return UnifiedCamera(v["xi"], focal, center, size, (k1, k2, p1, p2))
        case "ds":
            return DoubleSphereCamera(v["xi"], v["alpha"], focal, center, size)
        case "eucm":
            return ExtendedUnifiedCamera(v["alpha"], v["beta"], focal, center, size)
        case "equidistant":
            return EquidistantCamera((k1, k2, k3, k4), focal, center, size)
    return EquirectangularCamera(focal, center, size)


def changed(camera: OmniCamera, changes: Mapping[str, float]) -> OmniCamera:
    """Return the camera after changes of named parameters; CalibError for a name or a result of no such camera.

    d of an ocam camera moves d and e alike, because their difference is a rotation of the camera.
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
    """Return the name of a camera's model, and the view of one that may be a mirror's or a lens's."""
    return f"ocam, {camera.view} view" if isinstance(camera, OcamCamera) else model_name(camera)


def sees_directly(camera: OmniCamera) -> bool:
    """True for a camera without a mirror, of whichever model: its image has no hub and need not have a rim."""
    if isinstance(camera, OcamCamera):
        return camera.view == "direct"
    if isinstance(camera, UnifiedCamera):
        return camera.xi == 0 or camera.focal[0] * camera.focal[1] > 0  # a mirror flips its image
    return True


def visible_part(camera: OmniCamera) -> Mask:
    """Return the mask if none is known: the whole image of a lens, and the largest disc in that of a mirror."""
    return whole_image(camera) if sees_directly(camera) else inscribed_mask(camera)
