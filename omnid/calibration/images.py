"""Images of two cameras for a calibration: lower_*, upper_* of a folder, or the pairs of a log."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from calib.rig import SIDES
from drivers.errors import FrameDecodeError
from drivers.frame import MAX_PIXELS, Frame, gray, upper_eight_bits
from drivers.logs.image_folder import IMAGE_SUFFIXES, image_folders
from drivers.logs.log_reader import BY_NAME, LogCameras, LogReader, is_log_name
from omnid.errors import OmnidError

Image = NDArray[np.uint8]
# Images of one camera by the name of their instant, all of one size.
Images = dict[str, Image]
# Largest difference between the stamps of a pair: boards are held still, so that 10 ms show the same instant.
TOLERANCE_NS = 10_000_000
# Number of pairs of a log that are used, evenly spread: a board held by hand moves little between two of them.
LOG_PAIRS = 60


@dataclass(frozen=True, slots=True)
class PairedImages:
    """Images of the lower and the upper camera by the name of the instant; some instants have one camera only."""

    sides: tuple[Images, Images]
    topics: tuple[str, str] = ("", "")
    notes: tuple[str, ...] = ()  # about images that were left out, and faults of a log

    @property
    def names(self) -> list[str]:
        """Return the names of all instants, sorted."""
        return sorted({**self.sides[0], **self.sides[1]})


def read_pairs(source: Path, cameras: LogCameras = BY_NAME) -> PairedImages:
    """Read the images of a folder or a log. Raises OmnidError without any pair."""
    is_log = is_log_name(source.name)
    if source.is_dir():  # a folder of a log's files, or of folders of images, one for each camera
        has_folders = not any(source.glob(f"{SIDES[0]}_*")) and len(image_folders(source)) > 1
        is_log |= has_folders or any(is_log_name(path.name) for path in source.iterdir())
    faults, topics = list[str](), ("", "")
    if is_log:
        with closing(LogReader(source, cameras)) as reader:
            sides = _of_log(reader, faults)
            topics = reader.topics["lower"], reader.topics["upper"]
    elif cameras.lower or cameras.upper:
        raise OmnidError(f"{source}: only a log has topics; found a folder of images")
    elif source.is_dir():
        sides = _of_side(source, SIDES[0], cameras.bits), _of_side(source, SIDES[1], cameras.bits)
    else:
        raise OmnidError(
            f"{source}: expected a log (.mcap, .db3, .bag) or a folder with images lower_*, upper_*; "
            f"found {'a file' if source.exists() else 'no such file or folder'}"
        )
    for side in sides:
        if len(shapes := {image.shape for image in side.values()}) > 1:
            raise OmnidError(f"{source}: expected all images of a camera of one size, found {sorted(shapes)}")
    if not sides[0].keys() & sides[1].keys():
        expected = "pairs like lower_001.png and upper_001.png"
        if is_log:
            expected = f"images whose stamps differ by less than {TOLERANCE_NS // 10**6} ms"
        raise OmnidError("; ".join([f"{source}: no pair of images: expected {expected}", *faults]))
    return PairedImages(sides, topics, tuple(faults))


def _of_log(reader: LogReader, faults: list[str]) -> tuple[Images, Images]:
    """Return the images of both cameras by the names of their pairs; add what is wrong to faults."""
    lower, upper = Images(), Images()
    for number, *frames in spread_pairs(reader, LOG_PAIRS, TOLERANCE_NS):
        try:
            lower[f"pair{number:05d}"], upper[f"pair{number:05d}"] = gray(frames[0]), gray(frames[1])
        except FrameDecodeError as error:
            faults.append(f"left out a pair: {error}")
    faults += reader.warnings
    return lower, upper


def _of_side(folder: Path, side: str, bits: int) -> Images:
    """Return the images of one camera by the name of their instant: lower_001.png is that of 001."""
    paths = dict[str, Path]()
    for path in sorted(path for path in folder.glob(f"{side}_*") if path.suffix.lower() in IMAGE_SUFFIXES):
        if (other := paths.setdefault(path.stem.removeprefix(f"{side}_"), path)) != path:
            raise OmnidError(f"{folder}: {other.name} and {path.name} have one name; remove or rename one of them")
    if not paths:
        raise OmnidError(f"{folder}: no images {side}_* in this folder; name them lower_001.png, upper_001.png ...")
    return {name: _read(path, bits) for name, path in paths.items()}


def _read(path: Path, bits: int) -> Image:
    """Return a grey image (H, W) uint8. bits: significant bits of a 16-bit sample, whose upper eight are kept."""
    flags = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION | cv2.IMREAD_ANYDEPTH
    try:
        data = np.frombuffer(path.read_bytes(), np.uint8)
        image = cv2.imdecode(data, flags) if data.size else None
    except OSError as error:
        raise OmnidError(f"{path}: cannot be read: {error.strerror or error}") from error
    except cv2.error:
        image = None
    if image is None or image.size > MAX_PIXELS or image.dtype not in (np.uint8, np.uint16):
        raise OmnidError(
            f"{path}: expected an image (PNG, JPEG, TIFF ...) of at most {MAX_PIXELS} pixels, found none; leave it out"
        )
    return np.ascontiguousarray(image if image.dtype == np.uint8 else upper_eight_bits(image, bits), np.uint8)


def spread_pairs(reader: LogReader, max_count: int, tolerance_ns: float) -> Iterator[tuple[int, Frame, Frame]]:
    """Yield number, lower and upper frame of at most max_count pairs, evenly spread over a log, undecoded."""
    stride = max(1, -(-sum(1 for _ in _paired(reader.frames(), tolerance_ns)) // max_count))
    for number, (lower, upper) in enumerate(_paired(reader.frames(), tolerance_ns)):
        if number % stride == 0:
            yield number, lower, upper


def _paired(frames: Iterator[Frame], tolerance_ns: float) -> Iterator[tuple[Frame, Frame]]:
    """Yield pairs of lower and upper frames with nearly equal stamps, from frames in order of stamps, undecoded."""
    waiting: Frame | None = None
    for frame in frames:
        if waiting and waiting.camera != frame.camera and frame.stamp_ns - waiting.stamp_ns <= tolerance_ns:
            yield (waiting, frame) if frame.camera == "upper" else (frame, waiting)
            waiting = None
        else:
            waiting = frame


def brightest(images: Iterable[Image]) -> Image:
    """Return the maximum (H, W) of images of one size, in which the rim of a mirror is clearest."""
    return np.asarray(np.max(np.stack(list(images)), axis=0), np.uint8)


def middle_px(image: Image) -> tuple[float, float]:
    """Return the middle (u, v) of an image, px."""
    height, width = image.shape
    return (width - 1) / 2, (height - 1) / 2
