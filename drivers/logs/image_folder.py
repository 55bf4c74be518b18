"""Folders of images with stamps, one folder for each camera.

The stamp of an image is its name without suffix (1403636579763555584.png, 1305031102.175304.jpg), or the line of its
number in timestamps.txt or times.txt in the folder of the images or the one above. Images that are named by low whole
numbers that follow each other are numbered, not stamped, and are refused without such a list. A stamp is in nanoseconds
where it is a whole number of 16 digits or more; otherwise in seconds, or a date and time (UTC). Shorter whole numbers
may have been meant as nanoseconds since a start: images that lie hours apart are refused, because their user must say
what is meant.

Files of 16 bits a sample may hold the 10 or 12 bits of a camera. That is so where 16 images of a folder, evenly spread,
have no larger sample; all images of the folder are then read by the upper eight of these bits.
"""

from __future__ import annotations

import errno
import math
import os
import re
import stat
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from datetime import UTC, datetime
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Final, NamedTuple

from drivers.errors import DriverError, FrameDecodeError
from drivers.frame import FILE_BITS, bits_of_camera, deep_samples, upper_eight_bits
from drivers.logs.image_log import LogDamage, LoggedImage
from drivers.logs.mcap_records import MAX_RECORD_BYTES, RecordError
from drivers.logs.ros_image import COMPRESSED_IMAGE, RosImage, image_encoding

SUFFIXES: Final = (".png", ".jpg", ".jpeg")
# What OpenCV reads as an image, as of boards: a log has those above.
IMAGE_SUFFIXES: Final = frozenset({*SUFFIXES, ".bmp", ".pgm", ".ppm", ".tif", ".tiff", ".webp"})
STAMP_FILES: Final = ("timestamps.txt", "times.txt")
ATTACHMENT: Final = "rig.toml"  # The rig's file, in the same folder as the folders of the cameras.
MAX_IMAGES: Final = 1_000_000
_MAX_DEPTH: Final = 4  # Folders of images are searched down to this depth below the given one.
_MAX_FOLDERS: Final = 64
_MAX_VISITED: Final = 10_000
_MAX_STAMP_BYTES: Final = 64 * 2**20
_MAX_ATTACHMENT_BYTES: Final = 16 * 2**20
# The year 2116: two stamps differ by what fits 64 bits, and trajectories (omnid/formats/tum.py) have the same limit.
_MAX_STAMP_NS: Final = 2**62
_LONGEST_GAP_NS: Final = 3600 * 10**9  # Stamps of two successive images that differ by more are not those of one log.
# No pair of cameras takes 1,000 images a second, as those of one a second that are named by microseconds seem to.
_SHORTEST_STEP_NS: Final = 1_000_000
_NS_DIGITS: Final = 16
_BITS_IMAGES: Final = 16  # images of a camera that show the bits of its samples
# Lower whole numbers as names count images: seconds since 1970 are above since 2001, and no camera of a robot takes one
# image a second.
_FIRST_SECONDS: Final = 10**9
_SECONDS: Final = re.compile(r"\d{1,12}(?:\.(\d{1,12}))?")


class _StampedFile(NamedTuple):
    stamp_ns: int
    topic: str
    path: Path


def image_folders(path: Path) -> list[Path]:
    """Return the folders with images below a folder, at most 64, of the first 10,000 folders that are visited."""
    found: list[Path] = []
    for visited, (folder, inner, files) in enumerate(os.walk(path)):
        here = Path(folder)
        inner[:] = sorted(inner) if len(here.relative_to(path).parts) < _MAX_DEPTH else []
        if here != path and any(Path(name).suffix.lower() in SUFFIXES for name in files):
            found.append(here)
        if visited >= _MAX_VISITED or len(found) >= _MAX_FOLDERS:
            break
    return found


class ImageFolder:
    """An ImageLog of folders of images; the topic of each is its path below the given folder.

    Raises DriverError where an image has no stamp.
    """

    def __init__(self, path: Path, folders: Sequence[Path]) -> None:
        self.name = str(path)
        self._path, self._closed = path, False
        self._files = {folder.relative_to(path).as_posix(): list(_stamped(path, folder)) for folder in folders}
        for files in self._files.values():
            _require_plausible(sorted(files))
        if sum(map(len, self._files.values())) > MAX_IMAGES:
            raise DriverError(f"{self.name!r} contains more than {MAX_IMAGES} images; give a part of them")

    def topics(self) -> Mapping[str, str]:
        """Return folder -> sensor_msgs/msg/CompressedImage."""
        return dict.fromkeys(self._files, COMPRESSED_IMAGE)

    def counts(self) -> Mapping[str, int] | None:
        """Return the number of images in each folder."""
        return {topic: len(files) for topic, files in self._files.items()}

    def messages(self) -> Iterator[LoggedImage]:
        """Yield the images of all folders in the order of their stamps."""
        bits = {topic: _bits_of_camera(files) for topic, files in self._files.items()}
        for file in sorted(file for files in self._files.values() for file in files):
            if self._closed:
                return
            yield LoggedImage(file.topic, file.stamp_ns, partial(_read, file, bits[file.topic]))

    def attachments(self) -> dict[str, bytes]:
        """Return the rig.toml in the folder of the folders, if it is a regular file of at most 16 MiB."""
        try:
            _require_own_files(self._path, [self._path / ATTACHMENT])
            data = _read_regular(self._path / ATTACHMENT, _MAX_ATTACHMENT_BYTES + 1)
        except (OSError, DriverError):
            return {}
        return {ATTACHMENT: data} if len(data) <= _MAX_ATTACHMENT_BYTES else {}

    def damage(self) -> LogDamage:
        """Return none: a file that is no image is counted when it is read."""
        return LogDamage()

    def close(self) -> None:
        """End messages()."""
        self._closed = True


def _stamped(top: Path, folder: Path) -> Iterator[_StampedFile]:
    """Yield the images of a folder with their stamps; raise DriverError where one has none."""
    topic = folder.relative_to(top).as_posix()
    paths = sorted((path for path in folder.iterdir() if path.suffix.lower() in SUFFIXES), key=_numbers_of)
    _require_own_files(top, paths)
    lines = _stamp_lines(folder)
    if lines is not None and len(lines) != len(paths):
        raise DriverError(
            f"{str(folder)!r} contains {len(paths)} images, and its list of stamps {len(lines)} lines; "
            "they must be as many"
        )
    if lines is None and _are_counted([path.stem for path in paths]):
        raise DriverError(
            f"the images of {str(folder)!r} are numbered, {paths[0].name!r} and so on, and their times are not known: "
            f"write a stamp a line, in seconds or nanoseconds, to {STAMP_FILES[0]} in this folder or the one above"
        )
    for index, path in enumerate(paths):
        text = path.stem if lines is None else lines[index]
        stamp_ns = parse_stamp(text)
        if stamp_ns is None:
            where = "is named" if lines is None else "has the stamp"
            raise DriverError(
                f"{str(path)!r} {where} {text[:40]!r}; expected a stamp: nanoseconds of 16 digits or "
                f"more, or seconds, as name or in {' or '.join(STAMP_FILES)}"
            )
        yield _StampedFile(stamp_ns, topic, path)


def _are_counted(names: Sequence[str]) -> bool:
    """True for names that count images: whole numbers, too low for times since 1970, most of which follow another."""
    if not all(name.isascii() and name.isdigit() and len(name) < _NS_DIGITS for name in names):
        return False
    numbers = sorted(map(int, names))
    followers = sum(after - before == 1 for before, after in pairwise(numbers))
    return followers > len(numbers) // 2 and numbers[-1] < _FIRST_SECONDS


def _numbers_of(path: Path) -> list[tuple[int, str]]:
    """Return a key that sorts names by the numbers in them: 9.png comes before 10.png."""
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in re.split(r"(\d+)", path.name)]


def _require_plausible(files: Sequence[_StampedFile]) -> None:
    """Raise DriverError where images that follow each other lie more than an hour, or next to no time, apart."""
    steps_ns = sorted(after.stamp_ns - before.stamp_ns for before, after in pairwise(files))
    if steps_ns and 0 < steps_ns[len(steps_ns) // 2] <= _SHORTEST_STEP_NS:
        raise DriverError(
            f"the images beside {str(files[0].path)!r} are {steps_ns[len(steps_ns) // 2] / 1000:g} us apart by their "
            "stamps: whole numbers of 16 and more digits are nanoseconds; give those in microseconds as seconds or "
            f"nanoseconds since 1970 in {STAMP_FILES[0]}"
        )
    for before, after in pairwise(files):
        gap_ns = after.stamp_ns - before.stamp_ns
        if gap_ns > _LONGEST_GAP_NS:
            raise DriverError(
                f"{str(before.path)!r} and {after.path.name!r} are {_in_words(gap_ns)} apart by their "
                "stamps; whole numbers of fewer than 16 digits are seconds: give the stamps in seconds "
                f"or in nanoseconds since 1970 in {STAMP_FILES[0]}, or split the log at the gap"
            )


def _in_words(gap_ns: int) -> str:
    """Return a time of hours, days or years."""
    hours = gap_ns / 3600e9
    if hours < 48:
        return f"{hours:.1f} hours"
    return f"{hours / 24:.0f} days" if hours < 9000 else f"{hours / 8766:.1f} years"


def _require_own_files(top: Path, paths: Sequence[Path]) -> None:
    """Raise DriverError, in one line, where a path is no regular file below the folder `top`.

    A pipe or a device would be waited for without an end, and a link could lead to any file of the machine.
    """
    real_top = os.path.realpath(top)
    others = [
        path
        for path in paths
        if not path.is_file() or os.path.commonpath([real_top, os.path.realpath(path)]) != real_top
    ]
    if others:
        more = f" and {len(others) - 1} more" if len(others) > 1 else ""
        raise DriverError(
            f"{str(others[0])!r}{more}: no regular file of the folder {str(top)!r}, but a pipe, a "
            "device, a folder, or a link out of it: remove it, or copy what it leads to"
        )


def _read_regular(path: Path, most_bytes: int) -> bytes:
    """Return the first bytes of a file. Raise OSError for anything but a file; a pipe is not waited for."""
    with open(os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC), "rb") as file:
        if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
            raise OSError(errno.EINVAL, "it is no regular file")
        return file.read(most_bytes)


def _stamp_lines(folder: Path) -> list[str] | None:
    """Return the lines of the list of stamps in the folder of the images or above; None without one."""
    for path in (place / name for place in (folder, folder.parent) for name in STAMP_FILES):
        try:
            if path.is_file() and path.stat().st_size <= _MAX_STAMP_BYTES:
                lines = path.read_text("utf-8", "replace").splitlines()
                return [line.strip() for line in lines if line.strip() and not line.startswith("#")]
        except OSError as error:
            raise DriverError(f"cannot read the stamps {str(path)!r}: {error.strerror}") from error
    return None


def parse_stamp(text: str) -> int | None:
    """Return a stamp [ns], None for another text; exact, because a float holds no nanoseconds since 1970."""
    if text.isascii() and text.isdigit() and len(text) >= _NS_DIGITS:
        stamp_ns = int(text) if len(text) <= len(str(_MAX_STAMP_NS)) else _MAX_STAMP_NS
    elif match := _SECONDS.fullmatch(text):
        stamp_ns = int(text.partition(".")[0]) * 10**9 + int((match[1] or "")[:9].ljust(9, "0"))
    elif (seconds := _float(text)) is not None:
        stamp_ns = round(seconds * 1e9)
    else:
        return _parse_date(text)
    return stamp_ns if stamp_ns < _MAX_STAMP_NS else None


def _float(text: str) -> float | None:
    """Return seconds such as 1.036336e-01, None where the text is no such number."""
    try:
        seconds = float(text)
    except ValueError:
        return None
    if "_" in text:  # which Python takes for a mark between digits
        return None
    return seconds if math.isfinite(seconds) and 0 <= seconds < _MAX_STAMP_NS * 1e-9 else None


def _parse_date(text: str) -> int | None:
    """Return the stamp of a date and time such as 2011-09-26 13:02:25.951199337 (UTC)."""
    whole, _, fraction = text.partition(".")
    try:
        date = datetime.fromisoformat(whole)
        seconds = int((date if date.tzinfo else date.replace(tzinfo=UTC)).timestamp())
    except ValueError:
        return None
    if fraction and not (fraction.isascii() and fraction.isdigit()):
        return None
    return seconds * 10**9 + int(fraction[:9].ljust(9, "0")) if seconds >= 0 else None


def _bits_of_camera(files: Sequence[_StampedFile]) -> int:
    """Return the bits of the samples in the images of a camera, 16 where they are not fewer or the files have eight."""
    largest = 0
    for file in files[:: max(1, len(files) // _BITS_IMAGES)]:
        with suppress(RecordError, FrameDecodeError):
            deep = deep_samples(_read(file, FILE_BITS).frame())
            if deep is None:
                return FILE_BITS
            largest = max(largest, int(deep.max()))
    return bits_of_camera(largest)


def _read(file: _StampedFile, bits: int) -> RosImage:
    """Return an image: the file, or its pixels where a camera has fewer than 16 bits in files of 16."""
    try:
        data = _read_regular(file.path, MAX_RECORD_BYTES)
    except OSError as error:
        raise RecordError(f"{str(file.path)!r} cannot be read: {error.strerror}") from error
    image = RosImage(file.stamp_ns, image_encoding(data), memoryview(data))
    if bits == FILE_BITS:
        return image
    with suppress(FrameDecodeError):  # who decodes the file says what is wrong with it
        deep = deep_samples(image.frame())
        if deep is not None:
            pixels = memoryview(upper_eight_bits(deep, bits).tobytes())
            return RosImage(file.stamp_ns, "mono8", pixels, deep.shape[1], deep.shape[0])
    return image
