"""Folders of images, one folder for each camera.

When an image was taken is stated in one of three ways:

1. `rate_hz`: so many images a second, in the natural order of their names, from 0 s on;
2. times.txt or timestamps.txt in the folder of the images or the one above: a line with a stamp for each image, in the
   natural order of their names: seconds, nanoseconds of 16 to 19 digits, or a date and a time as of KITTI;
3. its name: nanoseconds of 16 to 19 digits as of EuRoC (1403636579763555584.png), or seconds with a decimal point as of
   TUM.
"""

from __future__ import annotations

import errno
import math
import os
import re
from collections.abc import Sequence
from decimal import Decimal
from itertools import islice
from pathlib import Path
from typing import Final

import numpy as np

from drivers.errors import DriverError, RecordError
from drivers.logs.log import ENTRY, LATEST_NS, MAX_ATTACHMENT_BYTES, MAX_RECORD_BYTES, Entries, LogFile, Topic
from drivers.logs.ros_messages import COMPRESSED_IMAGE, compressed_image

SUFFIXES: Final = (".png", ".jpg", ".jpeg")
# Images of boards, which OpenCV reads; those of a log have one of SUFFIXES.
IMAGE_SUFFIXES: Final = frozenset({*SUFFIXES, ".bmp", ".pgm", ".ppm", ".tif", ".tiff", ".webp"})
ATTACHMENT: Final = "rig.toml"  # The rig's file, in the same folder as the folders of the cameras.
_LISTS: Final = ("times.txt", "timestamps.txt")
_NANOSECONDS: Final = re.compile(r"\d{16,19}")
_MAX_VISITED: Final = 10_000


def image_folders(path: Path) -> list[Path]:
    """Return the folders with images below a folder, among the first 10,000 folders that are visited."""
    visited = sorted(islice(os.walk(path), _MAX_VISITED))
    return [Path(folder) for folder, _, files in visited if Path(folder) != path and any(map(_is_image, files))]


def _is_image(name: str) -> bool:
    """True for the name of an image; hidden files such as ._1.png are of macOS."""
    return Path(name).suffix.lower() in SUFFIXES and not name.startswith(".")


class ImageFolder(LogFile):
    """A LogFile of folders of images; the topic of each is its path below the given folder.

    Raises DriverError where an image has no stamp.
    """

    def __init__(self, path: Path, folders: Sequence[Path], rate_hz: float = 0.0) -> None:
        """rate_hz: images a second; 0: their names or a list state their stamps."""
        super().__init__(str(path))
        if not 0.0 <= rate_hz < math.inf:
            raise DriverError(f"{self.name!r}: a rate of {rate_hz:g} images a second is given: expected one above 0")
        self._path = path
        self._images: list[tuple[int, int, Path]] = []  # folder, stamp [ns], file
        counts = dict[str, int]()
        for number, folder in enumerate(folders):
            stamped = _stamped(folder, rate_hz)
            self._images += ((number, stamp_ns, image) for stamp_ns, image in sorted(stamped))
            self.topics[number] = Topic(folder.relative_to(path).as_posix(), COMPRESSED_IMAGE)
            counts[self.topics[number].name] = len(stamped)
        if rate_hz and len(set(counts.values())) > 1:
            found = ", ".join(f"{count} in {name!r}" for name, count in counts.items())
            self.cut = (
                f"images of {self.name!r} are missing: found {found}; by a rate they are paired in the order of their "
                "names, wrongly behind a missing one: write times.txt"
            )

    def entries(self) -> Entries:
        """Return the places of the images."""
        return np.array([(f, ns, ns, 0, number) for number, (f, ns, _) in enumerate(self._images)], ENTRY)

    def read(self, block: int, offset: int) -> bytes:
        """Return an image as a message, whose stamp is that of the image; raise RecordError where it is unreadable."""
        _, stamp_ns, path = self._images[offset]
        try:
            return compressed_image(stamp_ns, _read_file(path, MAX_RECORD_BYTES))
        except OSError as error:
            raise RecordError(f"{str(path)!r} cannot be read: {error.strerror}") from error

    def attachments(self) -> dict[str, bytes]:
        """Return the rig.toml in the folder of the folders, if there is one."""
        try:
            return {ATTACHMENT: _read_file(self._path / ATTACHMENT, MAX_ATTACHMENT_BYTES)}
        except OSError:
            return {}

    def close(self) -> None:
        """Do nothing: no file is kept open."""


def _stamped(folder: Path, rate_hz: float) -> list[tuple[int, Path]]:
    """Return stamp [ns] and path of the images of a folder; raise DriverError where one has no stamp."""
    paths = sorted((path for path in folder.iterdir() if _is_image(path.name)), key=_numbers_of)
    if rate_hz:
        return [(round(index * 1e9 / rate_hz), path) for index, path in enumerate(paths)]
    lists = [file for place in (folder, folder.parent) for name in _LISTS if (file := place / name).is_file()]
    if lists:
        try:
            lines = [line.strip() for line in lists[0].read_text("utf-8-sig", "replace").splitlines()]
        except OSError as error:
            raise DriverError(f"cannot read the stamps {str(lists[0])!r}: {error.strerror}") from error
        texts = [line for line in lines if line and not line.startswith("#")]
        if len(texts) != len(paths):
            found = f"{len(paths)} images, and its list of stamps {len(texts)} lines"
            raise DriverError(f"{str(folder)!r} contains {found}; they must be as many")
    else:
        # A whole number of fewer digits is no time.
        texts = [path.stem if "." in path.stem or _NANOSECONDS.fullmatch(path.stem) else "" for path in paths]
    stamped = [(_stamp_ns(text), path) for text, path in zip(texts, paths, strict=True)]
    for stamp_ns, path in stamped:
        if stamp_ns is None:
            raise DriverError(
                f"{str(path)!r} has no stamp: expected nanoseconds of 16 to 19 digits as its name, or seconds in "
                f"{_LISTS[0]}; else give --rate HZ, which is log.rate_hz of the settings"
            )
    return [(stamp_ns, path) for stamp_ns, path in stamped if stamp_ns is not None]


def _stamp_ns(text: str) -> int | None:
    """Return a stamp, exactly: see the head of this file; None for another text."""
    try:
        if re.fullmatch(r"\d{4}-\d\d-\d\d[ T]\d\d:\d\d:\d\d(\.\d{1,9})?Z?", text):
            return int(np.datetime64(text.rstrip("Z").replace(" ", "T"), "ns").astype(np.int64))
        stamp_ns = Decimal(text) * (1 if _NANOSECONDS.fullmatch(text) else 10**9)
        return int(stamp_ns) if 0 <= stamp_ns < LATEST_NS and "_" not in text else None
    except (ArithmeticError, ValueError):
        return None


def _numbers_of(path: Path) -> list[tuple[int, str]]:
    """Return a key that sorts names by the numbers in them: 9.png comes before 10.png."""
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in re.split(r"(\d+)", path.name)]


def _read_file(path: Path, most_bytes: int) -> bytes:
    """Return the bytes of a file; raise OSError for a larger one, and for a pipe, which would be waited for."""
    if not path.is_file() or path.stat().st_size > most_bytes:
        raise OSError(errno.EINVAL, f"it is no regular file of at most {most_bytes} bytes")
    return path.read_bytes()
