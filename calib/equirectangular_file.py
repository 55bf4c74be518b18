"""Rigs of two stacked 360-degree cameras with stitched images: by their baseline, or of the data set Helvipad.

Helvipad (Zayene et al. 2025) has the folders images_top and images_bottom with images of 1920x512 px, which are the
rows 192 to 703 of stitched images of 1920x960, and calibration.json with `stereo_baseline` in centimetres. Its other
numbers are those of a lidar and of the lenses before stitching, which are not needed.
"""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np

from calib import se3
from calib.errors import CalibError
from calib.models.equirectangular import full_turn
from calib.rig import MAX_BASELINE_M, MIN_BASELINE_M, MountedCamera, Rig
from calib.validation import read_bytes

# Of the file of a rig and of an image, so that a wrong file is refused before it fills the memory: a rig has some
# hundred bytes, an image of 16384 x 8192 px about 100 MB.
MAX_BYTES, MAX_IMAGE_BYTES = 1 << 20, 1 << 28
# Size of the images of Helvipad, and their first row in the whole image. Source: Zayene et al. 2025.
HELVIPAD_SIZE, HELVIPAD_TOP_PX = (1920, 512), 192
SUFFIXES = (".png", ".jpg", ".jpeg")
# The camera's z is ahead in the middle of the image: the rig's x; its x is the rig's -y, its y the rig's -z.
R_RIG_CAM = np.array([[0, 0, 1.0], [-1, 0, 0], [0, -1, 0]])


def stacked_rig(size: tuple[int, int], baseline_m: float) -> Rig:
    """Return the rig of two cameras of stitched images, the upper one baseline_m straight above, equally oriented."""
    if not (np.isfinite(baseline_m) and MIN_BASELINE_M <= baseline_m <= MAX_BASELINE_M):
        raise CalibError(f"baseline: expected {MIN_BASELINE_M} to {MAX_BASELINE_M} m, found {baseline_m}")
    if size[0] != 2 * size[1] and size != HELVIPAD_SIZE:
        raise CalibError(
            f"equirectangular images: expected twice as many columns as rows, a full turn by half a turn, "
            f"or {HELVIPAD_SIZE[0]}x{HELVIPAD_SIZE[1]} as Helvipad has, found {size[0]}x{size[1]}; rows "
            "that were cut off are told by pv in a rig.toml of the model equirectangular"
        )
    camera = full_turn(size, HELVIPAD_TOP_PX if size == HELVIPAD_SIZE else 0)
    lower, upper = (
        MountedCamera(camera, se3.inverse(se3.transform(R_RIG_CAM, np.array([0.0, 0.0, height_m]))))
        for height_m in (0.0, baseline_m)
    )
    return Rig(lower, upper)


def import_helvipad(path: Path, images: Path) -> Rig:
    """Read the rig of Helvipad's calibration.json; images: a folder of the lower camera's images, or one of them."""
    name = str(path)
    try:
        values = json.loads(read_bytes(path, MAX_BYTES))
    except (ValueError, RecursionError) as error:
        raise CalibError(f"{name}: not a JSON file: {' '.join(str(error).split())[:200]}") from error
    baseline = values.get("stereo_baseline") if isinstance(values, dict) else None
    if not isinstance(baseline, int | float) or isinstance(baseline, bool):
        raise CalibError(
            f"{name}: expected the number 'stereo_baseline' [cm], as in Helvipad's calibration.json; "
            "`omnid calibrate import --equirectangular WIDTHxHEIGHT --baseline METRES` needs no file"
        )
    return stacked_rig(_image_size(images), 0.01 * float(baseline))


def _image_size(images: Path) -> tuple[int, int]:
    """Return the (width, height) of an image, or of the first one in a folder."""
    found = sorted(p for p in images.iterdir() if p.suffix.lower() in SUFFIXES) if images.is_dir() else [images]
    data = np.frombuffer(read_bytes(found[0], MAX_IMAGE_BYTES) if found else b"", np.uint8)
    image = cv2.imdecode(data, cv2.IMREAD_GRAYSCALE) if len(data) else None
    if image is None:
        raise CalibError(f"{images}: expected an image, or a folder of them, of the lower camera, found none")
    return image.shape[1], image.shape[0]
