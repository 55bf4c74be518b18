"""Calibrations of other programs as rigs of omnid: Kalibr's camchain.yaml, OCamCalib's files, stitched images.

- Kalibr: p_cam = T_cam_imu @ p_imu, p_cam1 = T_cn_cnm1 @ p_cam0, t_imu = t_cam + timeshift_cam_imu. T_cam_imu is taken
  for T_cam_rig.
- OCamCalib: one calib_results.txt for each camera; the upper one is straight above the lower one.
- Stitched images of two 360-degree cameras: their size and baseline are all there is.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Final, TypeAlias

import msgspec
import numpy as np

from calib import se3
from calib.errors import CalibError, within
from calib.models.camera import Array, OmniCamera
from calib.models.lens import full_turn
from calib.models.names import camera_of, sees_directly
from calib.models.ocam import OcamCamera, View
from calib.models.unified import DISTORTION_NAMES, UnifiedCamera
from calib.rig import (
    MAX_LEAN,
    MAX_UPPER_DELAY_S,
    MountedCamera,
    Rig,
    ShutterTimes,
    is_turned_over,
    mounting_notes,
    rig_between,
)
from calib.typed_toml import shown
from calib.validation import LineReporter, load_yaml, read_text, require_image_size, silent, transform_of

Matrix: TypeAlias = tuple[tuple[float, ...], ...]
LOWER_WORDS, UPPER_WORDS = {"lower", "bottom"}, {"upper", "top"}
_FOCAL: Final = ("fu", "fv", "pu", "pv")
# Kalibr's projection and distortion: the model, and the names of its intrinsics and of its distortion.
MODELS: Final[Mapping[tuple[str, str], tuple[str, tuple[str, ...], tuple[str, ...]]]] = {
    ("omni", "radtan"): ("omni", ("xi", *_FOCAL), DISTORTION_NAMES),
    ("omni", "none"): ("omni", ("xi", *_FOCAL), ()),
    ("pinhole", "radtan"): ("omni", _FOCAL, DISTORTION_NAMES),
    ("pinhole", "none"): ("omni", _FOCAL, ()),
    ("pinhole", "equidistant"): ("equidistant", _FOCAL, ("k1", "k2", "k3", "k4")),
    ("ds", "none"): ("ds", ("xi", "alpha", *_FOCAL), ()),
}


class KalibrCamera(msgspec.Struct, frozen=True):
    """A camera of a camchain.yaml."""

    camera_model: str
    intrinsics: tuple[float, ...]
    distortion_model: str
    distortion_coeffs: tuple[float, ...]
    resolution: tuple[int, int]
    rostopic: str = ""
    T_cam_imu: Matrix | None = None
    T_cn_cnm1: Matrix | None = None
    timeshift_cam_imu: float | None = None

    def camera(self) -> OmniCamera:
        """Return the camera; CalibError for a model or values that omnid does not have."""
        found = MODELS.get((self.camera_model, self.distortion_model))
        if found is None:
            known = ", ".join("-".join(names) for names in MODELS)
            raise CalibError(f"expected one of {known}, found {self.camera_model}-{self.distortion_model}")
        require_image_size("resolution", *self.resolution)
        model, *names = found
        values = {"xi": 0.0}  # that of a pinhole, which is an omni camera
        for own, numbers in zip(names, (self.intrinsics, self.distortion_coeffs), strict=True):
            if len(numbers) != len(own):
                raise CalibError(f"expected {len(own)} numbers ({' '.join(own)}), found {shown(numbers)}")
            values |= zip(own, numbers, strict=True)
        return camera_of(model, values, self.resolution)


def parse_chain(
    text: str,
    name: str = "camchain.yaml",
    lower: str = "",
    upper: str = "",
    frame: str = "imu",
    warn: LineReporter = silent,
) -> Rig:
    """Parse the rig of a camchain.yaml's text; lower and upper: names of cameras (cam0), instead of topic or height.

    frame: "imu": T_cam_imu is taken for T_cam_rig; "cameras": the rig frame is that of rig_between. warn: takes lines
    about what had to be assumed.
    """

    def warn_of_file(line: str) -> None:
        warn(f"{name}: {line}")

    with within(f"{name}: "):
        chain = _chain(load_yaml(text))
        # 1. The poses of the cameras, and which of them is lower.
        poses, has_rig_frame = _poses(chain)
        low, up = _lower_and_upper(chain, (lower, upper), poses, warn_of_file, has_rig_frame=has_rig_frame)
        if not {low, up} <= poses.keys():
            raise CalibError(f"no transform between {low} and {up}; expected T_cam_imu of both, or T_cn_cnm1")
        # 2. Their models. The file does not distinguish lenses from mirrors whose images were flipped.
        models = []
        for key in (low, up):
            with within(f"{key}: "):
                models.append(chain[key].camera())
        if any(isinstance(camera, UnifiedCamera) and camera.xi > 0 and sees_directly(camera) for camera in models):
            warn_of_file(
                "its omni cameras count as lenses, by their focal lengths; if these are mirrors whose images were "
                "flipped, give them masks in the rig.toml"
            )
        # 3. The rig, in the axes of the IMU or in those of its cameras.
        topics = chain[low].rostopic, chain[up].rostopic
        if has_rig_frame and frame == "imu":
            mounted = [MountedCamera(model, poses[key]) for model, key in zip(models, (low, up), strict=True)]
            rig = Rig(mounted[0], mounted[1], topics=topics)
            z = (rig.upper.viewpoint - rig.lower.viewpoint)[2] / rig.baseline_m
            if z < MAX_LEAN:
                warn_of_file(
                    "expected the upper camera along z of the IMU, whose axes become those of the rig, found it "
                    f"{np.rad2deg(np.arccos(z)):.0f} deg off: give --frame cameras, by which the rig frame follows "
                    "from the cameras, or add T_base_rig to the rig"
                )
        else:
            rig = rig_between(models[0], models[1], poses[low] @ se3.inverse(poses[up]), topics)
            for note in mounting_notes(rig):
                warn_of_file(f"{note} (or T_cn_cnm1 is inverted)" if is_turned_over(rig) else note)
        # 4. The delay of the upper camera: the difference of both cameras' shifts against the IMU's clock.
        shifts = chain[low].timeshift_cam_imu, chain[up].timeshift_cam_imu
        delay_s = 0.0 if shifts[0] is None or shifts[1] is None else shifts[1] - shifts[0]
        if abs(delay_s) > MAX_UPPER_DELAY_S:
            raise CalibError(f"timeshift_cam_imu: expected shifts in seconds, found a difference of {delay_s:g}")
        return replace(rig, times=ShutterTimes(delay_s))


def _chain(values: object) -> dict[str, KalibrCamera]:
    """Return the cameras cam0, cam1, ... in ascending order."""
    found = dict[str, KalibrCamera]()
    tables = values if isinstance(values, dict) else {}
    for key in sorted(tables, key=lambda key: (len(str(key)), str(key))):
        if re.fullmatch(r"cam\d{1,3}", str(key)):
            with within(f"{key}: "):
                found[key] = msgspec.convert(tables[key], KalibrCamera)
    if len(found) < 2:
        raise CalibError(f"expected two cameras (cam0, cam1) as Kalibr writes them, found {', '.join(found) or 'none'}")
    return found


def _poses(chain: Mapping[str, KalibrCamera]) -> tuple[dict[str, Array], bool]:
    """Return T_cam_common of each camera; True if the common frame is the rig's, False if it is the first camera's."""
    poses, has_rig_frame = dict[str, Array](), any(camera.T_cam_imu is not None for camera in chain.values())
    before = ""
    for key, camera in chain.items():
        if camera.T_cam_imu is not None:
            poses[key] = transform_of(camera.T_cam_imu, f"{key}.T_cam_imu")
        elif camera.T_cn_cnm1 is not None and before in poses:
            poses[key] = transform_of(camera.T_cn_cnm1, f"{key}.T_cn_cnm1") @ poses[before]
        elif not before and not has_rig_frame:
            poses[key] = np.eye(4)
        before = key
    return poses, has_rig_frame


def _lower_and_upper(
    chain: Mapping[str, KalibrCamera],
    named: tuple[str, str],
    poses: Mapping[str, Array],
    warn: LineReporter,
    *,
    has_rig_frame: bool,
) -> tuple[str, str]:
    """Return the names of the lower and the upper camera: those given, else by topic, else by height.

    poses: T_cam_common of the cameras, see _poses.
    """
    # 1. By name. The other one of two cameras need not be named.
    if unknown := [name for name in named if name and name not in chain]:
        raise CalibError(f"there is no camera {unknown[0]}, found {', '.join(chain)}")
    if len(chain) > 2 and not all(named):
        raise CalibError(f"expected two cameras, found {', '.join(chain)}; give --lower and --upper")
    others = [name for name in chain if name not in named]
    if any(named):
        low, up = named[0] or others[0], named[1] or others[0]
        if low == up:
            raise CalibError(f"lower and upper must be two cameras, found {low} for both")
        return low, up
    one, other = others
    # 2. By words in their topics.
    words = [set(re.split(r"[^a-z]+", camera.rostopic.lower())) for camera in chain.values()]
    first, second = (bool(found & LOWER_WORDS) - bool(found & UPPER_WORDS) for found in words)
    if first != second:
        return (one, other) if first > second else (other, one)
    # 3. By their heights in the rig frame, or by what is below in their images.
    orders, by = [(one, other), (other, one)] if len(poses) == 2 else [], "z of the IMU, which must point up"
    if has_rig_frame:
        heights = {name: float(se3.inverse(T)[2, 3]) for name, T in poses.items()}
        orders = [(low, up) for low, up in orders if heights[low] < heights[up]]
    else:
        by = "what is below in the images"
        models = {name: camera.camera() for name, camera in chain.items()}
        rigs = {(a, b): rig_between(models[a], models[b], poses[a] @ se3.inverse(poses[b])) for a, b in orders}
        orders = [order for order, rig in rigs.items() if not is_turned_over(rig)]
    if len(orders) == 1:
        warn(f"lower is {orders[0][0]} by {by}; if that is wrong, give --lower {orders[0][1]}")
        return orders[0]
    raise CalibError(f"neither topics nor heights identify the lower camera; name it, --lower {one} or --lower {other}")


# 2. OCamCalib's `calib_results.txt`, and the transform between two cameras.
def import_pair(
    lower_path: Path, upper_path: Path, T_lower_upper: Array, view: View = "mirror", warn: LineReporter = silent
) -> Rig:
    """Read the rig of two files of OCamCalib; its frame is the lower viewpoint's, see rig_between."""
    lower, upper = (parse_ocam(read_text(path), view, str(path)) for path in (lower_path, upper_path))
    rig = rig_between(lower, upper, T_lower_upper)
    for note in mounting_notes(rig):
        warn(note)
    return rig


def parse_ocam(text: str, view: View = "mirror", name: str = "calib_results.txt") -> OcamCamera:
    """Parse the camera of a calib_results.txt's text; the inverse polynomial, of any length, is not used."""
    with within(f"{name}: "):
        words = (line.partition("#")[0].replace(",", " ").split() for line in text.splitlines())
        lines = [[float(word) for word in line] for line in words if line]
        lengths = [len(lines[0]) - 1 if lines else 0, *map(len, lines[-3:])]
        if len(lines) < 4 or lengths[1:] != [2, 3, 2] or lengths[0] != lines[0][0]:
            raise CalibError(
                "expected lines of numbers as OCamCalib writes them: polynomial with its length, inverse polynomial, "
                "centre, affine c d e, height and width of the image"
            )
        (row, column), (c, d, e), (height, width) = lines[-3:]
        require_image_size("image size", width, height)
        return OcamCamera(tuple(lines[0][1:]), (row, column), (c, d, e), (int(width), int(height)), view)


def straight_up(baseline_m: float) -> Array:
    """Return T_lower_upper of an upper camera straight above the lower one, equally oriented, both looking up.

    A lens that looks up, and a camera that looks up into its mirror, both have their z axis pointing down.
    """
    return se3.transform(np.eye(3), (0.0, 0.0, -baseline_m))


# 3. Stitched images.
def stacked_rig(size: tuple[int, int], baseline_m: float) -> Rig:
    """Return the rig of two cameras of stitched images, the upper one baseline_m straight above, equally oriented."""
    if size[0] != 2 * size[1]:
        raise CalibError(
            "equirectangular images: expected twice as many columns as rows, a full turn by half a turn, found "
            f"{size[0]}x{size[1]}; of images with fewer rows write the rig.toml by hand, whose pv states the horizon"
        )
    camera = full_turn(size)
    # The camera's z is ahead in the middle of the image: the rig's x; its x is the rig's -y, its y the rig's -z.
    R_rig_cam = np.array([[0, 0, 1.0], [-1, 0, 0], [0, -1, 0]])
    lower, upper = (
        MountedCamera(camera, se3.inverse(se3.transform(R_rig_cam, np.array([0.0, 0.0, height_m]))))
        for height_m in (0.0, baseline_m)
    )
    return Rig(lower, upper)
