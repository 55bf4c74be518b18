"""Folders of images, one folder for each camera.

When an image was taken is stated in one of three ways:

1. `rate_hz`: so many images a second, in the natural order of their names, from 0 s on;
2. times.txt (or timestamps.txt), in the folder of the images or the one above: a line of seconds for each image;
3. its name: nanoseconds, a whole number of 16 to 19 digits (1403636579763555584.png), or seconds with a decimal point.
"""

from __future__ import annotations

import errno
import math
import os
import re
import stat
from collections import Counter
from collections.abc import Iterator, Sequence
from decimal import Decimal, InvalidOperation
from itertools import pairwise
from pathlib import Path
from statistics import median_high
from typing import Final

import numpy as np

from drivers.errors import DriverError, RecordError
from drivers.logs.compression import MAX_RECORD_BYTES
from drivers.logs.image_times import SHORTEST_STEP_NS
from drivers.logs.log import ENTRY, MAX_ATTACHMENT_BYTES, Entries, Topic
from drivers.logs.ros_messages import COMPRESSED_IMAGE, compressed_image

SUFFIXES: Final = (".png", ".jpg", ".jpeg")
# What OpenCV reads as an image, as of boards: a log has those above.
IMAGE_SUFFIXES: Final = frozenset({*SUFFIXES, ".bmp", ".pgm", ".ppm", ".tif", ".tiff", ".webp"})
STAMP_FILES: Final = ("times.txt", "timestamps.txt")
ATTACHMENT: Final = "rig.toml"  # The rig's file, in the same folder as the folders of the cameras.
_MAX_DEPTH: Final = 4  # Folders of images are searched down to this depth below the given one.
_MAX_VISITED: Final = 10_000
_MAX_STAMP_NS: Final = 2**31 * 10**9  # of the times of ROS, which end in 2038
_GIVE_RATE: Final = "give --rate HZ, which is log.rate_hz of the settings"
_NANOSECONDS: Final = re.compile(r"\d{16,19}")


def image_folders(path: Path) -> list[Path]:
    """Return the folders with images below a folder, among the first 10,000 folders that are visited."""
    found: list[Path] = []
    for visited, (folder, inner, files) in enumerate(os.walk(path)):
        here = Path(folder)
        inner[:] = sorted(inner) if len(here.relative_to(path).parts) < _MAX_DEPTH else []
        if here != path and any(map(_is_image, files)):
            found.append(here)
        if visited >= _MAX_VISITED:
            break
    return found


def _is_image(name: str) -> bool:
    """True for the name of an image; hidden files such as ._1.png are of macOS."""
    return Path(name).suffix.lower() in SUFFIXES and not name.startswith(".")


class ImageFolder:
    """A LogFile of folders of images; the topic of each is its path below the given folder.

    Raises DriverError where an image has no stamp.
    """

    is_indexed = True

    def __init__(self, path: Path, folders: Sequence[Path], rate_hz: float = 0.0) -> None:
        """rate_hz: images a second; 0: their names or times.txt state their stamps."""
        if not 0.0 <= rate_hz < math.inf:
            raise DriverError(f"{str(path)!r}: a rate of {rate_hz:g} images a second is given: expected one above 0")
        self._path = path
        self._files = [_stamped(folder, rate_hz) for folder in folders]
        names = [folder.relative_to(path).as_posix() for folder in folders]
        self.topics = {number: Topic(name, COMPRESSED_IMAGE) for number, name in enumerate(names)}
        self.faults: Counter[str] = Counter()
        self.cut = ""
        counts = [len(files) for files in self._files]
        if rate_hz and len(set(counts)) > 1:
            found = ", ".join(f"{count} in {name!r}" for name, count in zip(names, counts, strict=True))
            self.cut = (
                f"images of {str(path)!r} are missing: found {found}; by a rate they are paired in the order of their "
                "names, wrongly behind a missing one: write times.txt"
            )

    def entries(self) -> Iterator[Entries]:
        """Yield the places of the images."""
        for folder, files in enumerate(self._files):
            places = [(folder, stamp_ns, folder, number) for number, (stamp_ns, _) in enumerate(files)]
            yield np.array(places, ENTRY)

    def read(self, channel: int, time_ns: int, block: int, offset: int, most: int = 0) -> bytes:
        """Return an image as a message, whose stamp is that of the image; raise RecordError where it is unreadable.

        most: above 0 without the image.
        """
        _, path = self._files[block][offset]
        try:
            return compressed_image(time_ns, b"" if most else _read_regular(path, MAX_RECORD_BYTES))
        except OSError as error:
            raise RecordError(f"{str(path)!r} cannot be read: {error.strerror}") from error

    def attachments(self) -> dict[str, bytes]:
        """Return the rig.toml in the folder of the folders, if it is a regular file of at most 16 MiB."""
        try:
            data = _read_regular(self._path / ATTACHMENT, MAX_ATTACHMENT_BYTES + 1)
        except OSError:
            return {}
        return {ATTACHMENT: data} if len(data) <= MAX_ATTACHMENT_BYTES else {}

    def close(self) -> None:
        """No file stays open."""


def _stamped(folder: Path, rate_hz: float) -> list[tuple[int, Path]]:
    """Return stamp [ns] and path of the images of a folder; raise DriverError where one has no stamp."""
    paths = sorted((path for path in folder.iterdir() if _is_image(path.name)), key=_numbers_of)
    if rate_hz:
        return [(round(index * 1e9 / rate_hz), path) for index, path in enumerate(paths)]
    lines = _stamp_lines(folder)
    if lines is not None and len(lines) != len(paths):
        raise DriverError(
            f"{str(folder)!r} contains {len(paths)} images, and its list of stamps {len(lines)} lines; "
            "they must be as many"
        )
    found = []
    for path, text in zip(paths, lines or [path.stem for path in paths], strict=True):
        is_name = lines is None
        stamp_ns = int(text) if is_name and _NANOSECONDS.fullmatch(text) else None
        if stamp_ns is None and ("." in text or not is_name):
            stamp_ns = _seconds_ns(text)
        if stamp_ns is None or stamp_ns >= _MAX_STAMP_NS:
            raise DriverError(
                f"{str(path)!r} {'is named' if is_name else 'has the stamp'} {text[:40]!r}: expected nanoseconds of 16 "
                f"to 19 digits as its name, or seconds in {STAMP_FILES[0]}; else {_GIVE_RATE}"
            )
        found.append((stamp_ns, path))
    found.sort()
    steps_ns = [after - before for (before, _), (after, _) in pairwise(found)]
    if lines is None and steps_ns and 0 < (step_ns := median_high(steps_ns)) <= SHORTEST_STEP_NS:
        raise DriverError(
            f"the images beside {str(paths[0])!r} are {step_ns / 1000:g} us apart, as names are nanoseconds; write "
            f"seconds to {STAMP_FILES[0]}, or {_GIVE_RATE}"
        )
    return found


def _numbers_of(path: Path) -> list[tuple[int, str]]:
    """Return a key that sorts names by the numbers in them: 9.png comes before 10.png."""
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in re.split(r"(\d+)", path.name)]


def _seconds_ns(text: str) -> int | None:
    """Return seconds such as 1305031102.175304 or 1.036336e-01 as nanoseconds, exactly; None for another text."""
    try:
        seconds = Decimal(text if "_" not in text else "")  # which Python takes for a mark between digits
    except InvalidOperation:
        return None
    return int(seconds * 10**9) if seconds.is_finite() and 0 <= seconds < _MAX_STAMP_NS else None


def _stamp_lines(folder: Path) -> list[str] | None:
    """Return the lines of the list of stamps in the folder of the images or above; None without one."""
    for path in (place / name for place in (folder, folder.parent) for name in STAMP_FILES):
        try:
            if path.is_file() and path.stat().st_size <= MAX_RECORD_BYTES:
                lines = path.read_text("utf-8-sig", "replace").splitlines()
                return [line.strip() for line in lines if line.strip() and not line.startswith("#")]
        except OSError as error:
            raise DriverError(f"cannot read the stamps {str(path)!r}: {error.strerror}") from error
    return None


def _read_regular(path: Path, most_bytes: int) -> bytes:
    """Return the first bytes of a file. Raise OSError for anything but a file; a pipe is not waited for."""
    with open(os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC), "rb") as file:
        if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
            raise OSError(errno.EINVAL, "it is no regular file")
        return file.read(most_bytes)
