"""Images of two cameras for a calibration: lower_*, upper_* of a folder, or the pairs of a log."""

from __future__ import annotations

import hashlib
import math
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from calib.rig import Rig
from drivers.errors import DriverError, FrameDecodeError
from drivers.frame import CAMERAS, MAX_PIXELS, Frame, gray, upper_eight_bits
from drivers.logs.image_folder import IMAGE_SUFFIXES, image_folders
from drivers.logs.log_reader import LogCameras, LogReader
from drivers.logs.open_log import is_log_name
from omnid.errors import OmnidError
from omnid.stages.synchronise import image_loss

Image = NDArray[np.uint8]
# By name, all of one size.
Images = dict[str, Image]
SIDES = ("lower", "upper")
# Largest difference between the stamps of a pair: boards are held still, so that 10 ms show the same instant.
TOLERANCE_NS = 10_000_000
# Number of pairs of a log that are used, evenly spread: a board held by hand moves little between two of them.
LOG_PAIRS = 100
MAX_IMAGES = 400
BY_NAME = LogCameras()


@dataclass(frozen=True, slots=True)
class PairedImages:
    """Images of the lower and the upper camera by the name of the instant; some instants have one camera only."""

    sides: tuple[Images, Images]
    topics: tuple[str, str] = ("", "")
    notes: tuple[str, ...] = ()  # about images that were left out, and faults of a log
    loss: str = ""  # one line where more than a tenth of a log's images make no pair

    @property
    def names(self) -> list[str]:
        """Return the names of all instants, sorted."""
        return sorted({**self.sides[0], **self.sides[1]})


def read_pairs(source: Path, cameras: LogCameras = BY_NAME) -> PairedImages:
    """Read the images of a folder or a log. Raises OmnidError without any pair.

    An instant whose images have all pixels of those of an earlier one is left out: it is no further view of a board,
    and would count the same errors again.
    """
    # 1. Read the images of both cameras.
    of_log = is_log_name(source.name)
    if source.is_dir():  # a folder of a log's files, or of folders of images, one for each camera
        has_folders = not any(source.glob(f"{SIDES[0]}_*")) and len(image_folders(source)) > 1
        of_log |= has_folders or any(is_log_name(path.name) for path in source.iterdir())
    if not of_log and (cameras.lower or cameras.upper):
        raise OmnidError(f"{source}: only a log has topics; found a folder of images")
    faults, loss = tuple[str, ...](), ""
    if of_log:
        with closing(cameras.reader(source)) as reader:
            read, images = decoded_pairs(reader)
            topics = reader.topics["lower"], reader.topics["upper"]
        lower, upper = ({f"pair{number:05d}": pair[side] for number, pair in images.items()} for side in (0, 1))
        sides, faults, loss = (lower, upper), tuple(read.notes), read.loss
    else:
        if not source.is_dir():
            raise OmnidError(
                f"{source}: expected a log (.mcap, .db3, .bag) or a folder with images lower_*, upper_*; "
                f"found {'a file' if source.exists() else 'no such file or folder'}"
            )
        sides, topics = (_of_side(source, SIDES[0], cameras.bits), _of_side(source, SIDES[1], cameras.bits)), ("", "")
    if not sides[0].keys() & sides[1].keys():
        counts = [len(side) for side in sides]
        expected = "pairs like lower_001.png and upper_001.png"
        if of_log:
            counts, expected = list(read.arrived), f"images whose stamps differ by less than {TOLERANCE_NS // 10**6} ms"
        counted = ", ".join(f"{count} of the {name} camera" for name, count in zip(SIDES, counts, strict=True))
        found = "; ".join([f"found {counted}", *faults])
        raise OmnidError(f"{source}: no pair of images: expected {expected}, {found}")
    # 2. Leave out those that repeat an earlier instant.
    repeated = _repeats(sides)
    kept = [{name: image for name, image in side.items() if name not in repeated} for side in sides]
    notes = tuple(f"left out {name}: the same image as {earlier}" for name, earlier in repeated.items())
    return PairedImages((kept[0], kept[1]), topics, (*faults, *([loss] if loss else []), *notes), loss)


def _repeats(sides: Sequence[Images]) -> dict[str, str]:
    """Return the instants whose images have all pixels of those of an earlier one: name -> the earlier name."""
    first, found = dict[tuple[bytes, ...], str](), dict[str, str]()
    for name in sorted({name for side in sides for name in side}):
        key = tuple(hashlib.sha256(side[name].tobytes()).digest() if name in side else b"" for side in sides)
        earlier = first.setdefault(key, name)
        if earlier != name:
            found[name] = earlier
    return found


def _of_side(folder: Path, side: str, bits: int) -> Images:
    """Return the images of one camera by the name of their instant: lower_001.png is that of 001."""
    paths = dict[str, Path]()
    for path in sorted(path for path in folder.glob(f"{side}_*") if path.suffix.lower() in IMAGE_SUFFIXES):
        if (other := paths.setdefault(path.stem.removeprefix(f"{side}_"), path)) != path:
            raise OmnidError(f"{folder}: {other.name} and {path.name} have one name; remove or rename one of them")
    if not paths:
        raise OmnidError(f"{folder}: no images {side}_* in this folder; name them lower_001.png, upper_001.png ...")
    if len(paths) > MAX_IMAGES:
        raise OmnidError(f"calibrate: expected {MAX_IMAGES} images at most, found {len(paths)}; 40 are enough")
    images = {name: _read(path, bits) for name, path in paths.items()}
    sizes = dict[tuple[int, ...], str]()
    for name, image in images.items():
        sizes.setdefault(image.shape[::-1], paths[name].name)
    if len(sizes) > 1:
        found = ", ".join(f"{width}x{height} ({name})" for (width, height), name in list(sizes.items())[:4])
        raise OmnidError(f"calibrate: expected images of one camera, all of one size, found {found}")
    return images


def _read(path: Path, bits: int) -> Image:
    """Return a grey image (H, W); of 16 bits a sample the upper eight of so many bits."""
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


class LogPairs(NamedTuple):
    """What of a log's pairs is not used."""

    loss: str  # one line where more than a tenth of the images make no pair
    notes: list[str]  # of the reader, and about pairs that were left out
    arrived: tuple[int, ...]  # images of the lower and the upper camera


def decoded_pairs(reader: LogReader, *, keep: bool = True) -> tuple[LogPairs, dict[int, tuple[Image, Image]]]:
    """Return the pairs of a log, of which up to twice LOG_PAIRS are decoded: number -> images of both cameras.

    keep: return these. What is lost is counted as in a run: of all images without a partner, and of those that were
    decoded.
    """
    # 1. Stamps of all images. In a run a pair may differ by half a period.
    frames = [replace(frame, data=b"") for frame in reader.frames()]
    stamps = {camera: [frame.stamp_ns for frame in frames if frame.camera == camera] for camera in CAMERAS}
    periods = {camera: float(np.median(np.diff(own))) if len(own) > 1 else math.nan for camera, own in stamps.items()}
    within_ns = max([TOLERANCE_NS, *(period / 2 for period in periods.values() if period > 0)])
    joined = sum(1 for _ in paired(iter(frames), within_ns))
    arrived = {camera: len(own) for camera, own in stamps.items()}
    unpaired = {camera: count - joined for camera, count in arrived.items()}
    stride = max(1, sum(1 for _ in paired(iter(frames))) // LOG_PAIRS)
    # 2. Images of some pairs; those of another size than most are of no use.
    images, faults = dict[int, tuple[Image, Image]](), list[str]()
    sizes = Counter[tuple[tuple[int, ...], ...]]()
    for number, (lower, upper) in enumerate(paired(reader.frames())):
        if number % stride == 0:
            try:
                pair = gray(lower), gray(upper)
            except FrameDecodeError as error:
                faults.append(str(error))
                continue
            sizes[pair[0].shape, pair[1].shape] += 1
            images |= {number: pair} if keep else {}
    usual, count = sizes.most_common(1)[0] if sizes else ((), 0)
    images = {number: pair for number, pair in images.items() if (pair[0].shape, pair[1].shape) == usual}
    others = sizes.total() - count
    # 3. What is lost.
    loss = image_loss(
        reader.counts,
        arrived,
        unpaired,
        periods,
        undecodable=2 * len(faults) * stride,
        other_size=2 * others * stride,
    )
    notes = list(reader.warnings)
    if faults:
        notes.append(f"left out {len(faults)} pairs with an image that cannot be decoded; the first: {faults[0]}")
    if others:
        notes.append(f"left out {others} pairs with an image of another size than most")
    return LogPairs(loss, notes, tuple(arrived.values())), images


def paired(frames: Iterator[Frame], tolerance_ns: float = TOLERANCE_NS) -> Iterator[tuple[Frame, Frame]]:
    """Yield pairs of lower and upper frames with nearly equal stamps, from frames in order of stamps, undecoded."""
    waiting: Frame | None = None
    for frame in frames:
        if waiting and waiting.camera != frame.camera and frame.stamp_ns - waiting.stamp_ns <= tolerance_ns:
            yield (waiting, frame) if frame.camera == "upper" else (frame, waiting)
            waiting = None
        else:
            waiting = frame


def open_log(log: Path, cameras: LogCameras, rig: Rig | None) -> LogReader:
    """Open the log's two cameras: by the requested topics, by the rig's if the log has them, or by their names."""
    if rig and not (cameras.lower or cameras.upper):
        lower, upper = rig.topics
        with suppress(DriverError):
            return cameras._replace(lower=lower or None, upper=upper or None).reader(log)
    return cameras.reader(log)


def brightest(images: Iterable[Image]) -> Image:
    """Return the maximum (H, W) of images of one size: of a mirror it shows the rim best."""
    return np.asarray(np.max(np.stack(list(images)), axis=0), np.uint8)


def middle_px(image: Image) -> tuple[float, float]:
    """Return the middle (u, v) of an image, px."""
    height, width = image.shape
    return (width - 1) / 2, (height - 1) / 2
