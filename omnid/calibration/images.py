"""Images of one camera: from files, folders and patterns, or from one topic of a log.

Files of 16 bits a sample may hold the 10 or 12 bits of a camera: where none of the images has a larger sample, all are
read by the upper eight of these bits.
"""

from __future__ import annotations

import glob
import hashlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from drivers.errors import FrameDecodeError
from drivers.frame import FILE_BITS, MAX_PIXELS, bits_of_camera, gray, upper_eight_bits
from drivers.logs.image_folder import IMAGE_SUFFIXES
from drivers.logs.image_log import ImageLog, LoggedImage, images_of
from drivers.logs.log_formats import LOG_SUFFIXES, open_image_log
from drivers.logs.mcap_records import RecordError
from drivers.logs.ros_image import IMAGE_TYPES
from drivers.logs.sample_bits import SampleBits
from omnid.errors import OmnidError

Image = NDArray[np.uint8]
# By name, all of one size.
Images = dict[str, Image]
MAX_IMAGES = 400
# Number of frames of a log that are used, evenly spread: a board held by hand moves little between two of them.
LOG_FRAMES = 120


def read_images(sources: Sequence[str], topic: str | None = None) -> Images:
    """Read grey images of files, folders and patterns, or of a log's topic; raises OmnidError unless all are readable
    and of one size."""
    logs = [source for source in sources if is_log(Path(source))]
    if logs and len(sources) > 1:
        raise OmnidError(f"{logs[0]}: expected images, or one log alone; found {len(sources)} names")
    if topic and not logs:
        raise OmnidError(f"--topic {topic}: only a log has topics; found images")
    images = _of_log(Path(logs[0]), topic) if logs else _of_files(sources)
    one_size(images)
    return images


def is_log(source: Path) -> bool:
    """True if a source of images is a log by its name."""
    return source.suffix in LOG_SUFFIXES


def repeats(sides: Sequence[Images]) -> dict[str, str]:
    """Return the names of images, or of images of several cameras of one instant, that have all pixels of earlier ones.

    sides: the images of each camera by the name of the instant. A repeated image is no further view of a board: it
    would count the same errors again. Return name -> the earlier name.
    """
    first, found = dict[tuple[bytes, ...], str](), dict[str, str]()
    for name in sorted({name for side in sides for name in side}):
        key = tuple(hashlib.sha256(side[name].tobytes()).digest() if name in side else b"" for side in sides)
        earlier = first.setdefault(key, name)
        if earlier != name:
            found[name] = earlier
    return found


def repeat_notes(repeated: Mapping[str, str]) -> tuple[str, ...]:
    """Return a line for each image that is left out because it repeats another one."""
    return tuple(f"left out {name}: the same image as {earlier}" for name, earlier in repeated.items())


def brightest(images: Iterable[Image]) -> Image:
    """Return the maximum (H, W) of images of one size: of a mirror it shows the rim best."""
    return np.asarray(np.max(np.stack(list(images)), axis=0), np.uint8)


def middle_px(image: Image) -> tuple[float, float]:
    """Return the middle (u, v) of an image, px."""
    height, width = image.shape
    return (width - 1) / 2, (height - 1) / 2


def _of_files(sources: Sequence[str]) -> Images:
    paths = list(dict.fromkeys(path for source in sources for path in _expanded(source)))
    if len(paths) > MAX_IMAGES:
        raise OmnidError(f"calibrate: expected {MAX_IMAGES} images at most, found {len(paths)}; 40 are enough")
    images = [np.asarray(_read(path), np.uint8) for path in paths]
    # The upper eight of 16 bits show which images hold fewer bits: only these are read again.
    if bits_of_camera(256 * max(int(image.max()) for image in images) + 255) < FILE_BITS:
        images = _by_the_bits_of_the_camera(paths, images)
    return dict(zip(_short_names(paths), images, strict=True))


def _by_the_bits_of_the_camera(paths: Sequence[Path], images: Sequence[Image]) -> list[Image]:
    """Return images of 8 bits as they are, and those of 16 by the upper eight of the 10 or 12 bits of their camera."""
    deep = [_read(path, cv2.IMREAD_ANYDEPTH) for path in paths]
    bits = bits_of_camera(max((int(image.max()) for image in deep if image.dtype == np.uint16), default=0))
    return [
        upper_eight_bits(samples, bits) if samples.dtype == np.uint16 else image
        for samples, image in zip(deep, images, strict=True)
    ]


def _expanded(source: str) -> list[Path]:
    """Return the files of a name, a folder or a pattern."""
    path = Path(source)
    if path.is_dir():
        found = sorted(file for file in path.iterdir() if file.suffix.lower() in IMAGE_SUFFIXES)
    else:
        found = [path] if path.exists() else sorted(map(Path, glob.glob(source)))
    if not found:
        what = f"no image ({' '.join(sorted(IMAGE_SUFFIXES))}) in this folder" if path.is_dir() else "no such file"
        raise OmnidError(f"{source}: {what}; give files, a folder or a pattern like 'calib/*.png'")
    return found


def _short_names(paths: Sequence[Path]) -> list[str]:
    """Return the file names, or the whole paths if two files have the same name."""
    short = [path.name for path in paths]
    return short if len(set(short)) == len(short) else [str(path) for path in paths]


def _read(path: Path, depth: int = 0) -> NDArray[Any]:
    """Return a grey image (H, W): uint8, or as in the file with depth IMREAD_ANYDEPTH."""
    flags = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION | depth
    try:
        data = np.frombuffer(path.read_bytes(), np.uint8)
        image = cv2.imdecode(data, flags) if data.size else None
    except OSError as error:
        raise OmnidError(f"{path}: cannot be read: {error.strerror or error}") from error
    except cv2.error:
        image = None
    if image is None or image.size > MAX_PIXELS:
        raise OmnidError(
            f"{path}: expected an image (PNG, JPEG, TIFF ...) of at most {MAX_PIXELS} pixels, found none; leave it out"
        )
    return np.ascontiguousarray(image)


def one_size(images: Images) -> None:
    """Raise OmnidError unless all images are of one size."""
    sizes: dict[tuple[int, ...], str] = {}
    for name, image in images.items():
        sizes.setdefault(image.shape[::-1], name)
    if len(sizes) > 1:
        shown = ", ".join(f"{size[0]}x{size[1]} ({name})" for size, name in list(sizes.items())[:4])
        raise OmnidError(f"calibrate: expected images of one camera, all of one size, found {shown}")


def _of_log(path: Path, topic: str | None) -> Images:
    with closing(open_image_log(path)) as log:
        chosen = _topic(path, log, topic)
        stride = max(1, sum(1 for _ in _images(log, chosen)) // LOG_FRAMES)
        return dict(_frames(log, chosen, stride))


def image_topic(path: Path, topic: str | None) -> str:
    """Return the requested topic of a log, or the only one with images."""
    with closing(open_image_log(path)) as log:
        return _topic(path, log, topic)


def _topic(path: Path, log: ImageLog, topic: str | None) -> str:
    """Return the requested topic, or the only one with images."""
    images = sorted(name for name, kind in log.topics().items() if kind in IMAGE_TYPES)
    if topic in images:
        return str(topic)
    if topic is None and len(images) == 1:
        return images[0]
    wanted = f"topic {topic}" if topic else "--topic, to select the camera"
    raise OmnidError(f"{path}: expected {wanted}, found image topics {', '.join(images) or '(none)'}")


def _images(log: ImageLog, topic: str) -> Iterator[LoggedImage]:
    return (image for image in images_of(log) if image.topic == topic)


def _frames(log: ImageLog, topic: str, stride: int) -> Iterator[tuple[str, Image]]:
    """Yield every stride-th image, named by its number, without those that cannot be decoded."""
    bits = SampleBits()
    for number, logged in enumerate(_images(log, topic)):
        if number % stride:
            continue
        try:
            yield f"frame{number:06d}", gray(bits.applied(topic, logged.read()).frame(seq=number))
        except (FrameDecodeError, RecordError):
            continue
