"""Folders of images, one folder for each camera.

When an image was taken is stated in one of three ways:

1. `rate_hz`: so many images a second, in the natural order of their names, from 0 s on;
2. a list in the folder of the images or the one above: times.txt or timestamps.txt with a stamp for each image, or any
   of STAMP_FILES with the names of the images and their stamps, as data.csv of EuRoC and rgb.txt of TUM;
3. its name: nanoseconds, a whole number of 16 to 19 digits (1403636579763555584.png), or seconds with a decimal point.

A stamp in a list is written as one in a name, in whole seconds, or as a date and a time (2011-09-26 13:02:25.96).
"""

from __future__ import annotations

import errno
import math
import os
import re
import stat
from collections.abc import Mapping, Sequence
from decimal import Decimal, InvalidOperation
from pathlib import Path
from typing import Final

import numpy as np

from drivers.errors import DriverError, RecordError
from drivers.logs.compression import MAX_RECORD_BYTES
from drivers.logs.log import ENTRY, MAX_ATTACHMENT_BYTES, Entries, LogFile, Topic
from drivers.logs.ros_messages import COMPRESSED_IMAGE, compressed_image

SUFFIXES: Final = (".png", ".jpg", ".jpeg")
# Images of boards, which OpenCV reads; those of a log have one of SUFFIXES.
IMAGE_SUFFIXES: Final = frozenset({*SUFFIXES, ".bmp", ".pgm", ".ppm", ".tif", ".tiff", ".webp"})
STAMP_FILES: Final = ("times.txt", "timestamps.txt", "data.csv", "rgb.txt")
ATTACHMENT: Final = "rig.toml"  # The rig's file, in the same folder as the folders of the cameras.
NANOSECOND_DIGITS: Final = 16  # Whole numbers of so many digits or more are nanoseconds.
_MAX_VISITED: Final = 10_000
_MAX_STAMP_NS: Final = 2**31 * 10**9  # of the times of ROS, which end in 2038
_GIVE_RATE: Final = "give --rate HZ, which is log.rate_hz of the settings"


def image_folders(path: Path) -> list[Path]:
    """Return the folders with images below a folder, among the first 10,000 folders that are visited."""
    found: list[Path] = []
    for visited, (folder, inner, files) in enumerate(os.walk(path)):
        here = Path(folder)
        inner.sort()
        if here != path and any(map(_is_image, files)):
            found.append(here)
        if visited >= _MAX_VISITED:
            break
    return found


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
        notes, counts = list[str](), dict[str, int]()
        for number, folder in enumerate(folders):
            stamped = _stamped(folder, rate_hz, notes)
            self._images += ((number, stamp_ns, image) for stamp_ns, image in sorted(stamped))
            name = folder.relative_to(path).as_posix()
            self.topics[number], counts[name] = Topic(name, COMPRESSED_IMAGE), len(stamped)
        if rate_hz and len(set(counts.values())) > 1:
            found = ", ".join(f"{count} in {name!r}" for name, count in counts.items())
            notes.append(
                f"images of {self.name!r} are missing: found {found}; by a rate they are paired in the order of their "
                "names, wrongly behind a missing one: write times.txt"
            )
        self.cut = "; ".join(notes)

    def entries(self) -> Entries:
        """Return the places of the images."""
        return np.array([(f, ns, ns, 0, number) for number, (f, ns, _) in enumerate(self._images)], ENTRY)

    def read(self, block: int, offset: int) -> bytes:
        """Return an image as a message, whose stamp is that of the image; raise RecordError where it is unreadable."""
        _, stamp_ns, path = self._images[offset]
        try:
            return compressed_image(stamp_ns, _read_regular(path, MAX_RECORD_BYTES))
        except OSError as error:
            raise RecordError(f"{str(path)!r} cannot be read: {error.strerror}") from error

    def attachments(self) -> dict[str, bytes]:
        """Return the rig.toml in the folder of the folders, if it is a regular file of at most 16 MiB."""
        try:
            data = _read_regular(self._path / ATTACHMENT, MAX_ATTACHMENT_BYTES + 1)
        except OSError:
            return {}
        return {ATTACHMENT: data} if len(data) <= MAX_ATTACHMENT_BYTES else {}


def _stamped(folder: Path, rate_hz: float, notes: list[str]) -> list[tuple[int, Path]]:
    """Return stamp [ns] and path of the images of a folder, in the order of names.

    notes: what is missing is added. Raise DriverError where an image has no stamp.
    """
    paths = sorted((path for path in folder.iterdir() if _is_image(path.name)), key=_numbers_of)
    if rate_hz:
        return [(round(index * 1e9 / rate_hz), path) for index, path in enumerate(paths)]
    # 1. A list.
    names = {path.name: path for path in paths}
    for listing in (place / name for place in (folder, folder.parent) for name in STAMP_FILES):
        rows = _rows(listing)
        named = dict(image for row in rows if (image := _named(row, names, folder)))
        if named:
            if len(named) < len(paths):
                unlisted = f"{len(paths) - len(named)} images of {str(folder)!r} are left out"
                notes.append(f"{unlisted}: {listing.name} does not list them")
            return [(_listed_ns(text, path), path) for path, text in named.items()]
        if rows and listing.name in STAMP_FILES[:2]:
            if len(rows) != len(paths):
                raise DriverError(
                    f"{str(folder)!r} contains {len(paths)} images, and its list of stamps {len(rows)} lines; "
                    "they must be as many"
                )
            return [(_listed_ns(" ".join(row), path), path) for row, path in zip(rows, paths, strict=True)]
    # 2. The names.
    found = []
    for path in paths:
        is_stamp = "." in path.stem or (path.stem.isdecimal() and len(path.stem) >= NANOSECOND_DIGITS)
        stamp_ns = _stamp_ns(path.stem) if is_stamp else None
        if stamp_ns is None:
            raise _no_stamp(path, "is named", path.stem)
        found.append((stamp_ns, path))
    return found


def _rows(listing: Path) -> list[list[str]]:
    """Return the words of the lines of a list, without comments and a head; empty without such a file."""
    try:
        if not listing.is_file() or listing.stat().st_size > MAX_RECORD_BYTES:
            return []
        lines = listing.read_text("utf-8-sig", "replace").splitlines()
    except OSError as error:
        raise DriverError(f"cannot read the stamps {str(listing)!r}: {error.strerror}") from error
    rows = [re.split(r"[\s,;]+", line.strip(" \t,;")) for line in lines if line.strip() and not line.startswith("#")]
    is_head = bool(rows) and not any(char.isdecimal() for word in rows[0] for char in word)
    return rows[1:] if is_head else rows


def _named(row: Sequence[str], images: Mapping[str, Path], folder: Path) -> tuple[Path, str] | None:
    """Return the image that a row names, and the row's stamp; a list above the folders may name those of all."""
    for column, word in enumerate(row):
        name = Path(word)
        if name.name in images and name.parent.name in ("", folder.name):
            return images[name.name], " ".join([*row[:column], *row[column + 1 :]])
    return None


def _listed_ns(text: str, path: Path) -> int:
    stamp_ns = _stamp_ns(text)
    if stamp_ns is None:
        raise _no_stamp(path, "has the stamp", text)
    return stamp_ns


def _no_stamp(path: Path, found: str, text: str) -> DriverError:
    return DriverError(
        f"{str(path)!r} {found} {text[:40]!r}: expected nanoseconds of 16 to 19 digits as its name, or seconds in "
        f"{STAMP_FILES[0]}; else {_GIVE_RATE}"
    )


def _stamp_ns(text: str) -> int | None:
    """Return a stamp, exactly: see the head of this file; None for another text."""
    try:
        if re.fullmatch(r"\d{4}-\d\d-\d\d[ T]\d\d:\d\d:\d\d(\.\d{1,9})?Z?", text):
            return int(np.datetime64(text.rstrip("Z").replace(" ", "T"), "ns").astype(np.int64))
        stamp = Decimal(text if "_" not in text else "")  # Python allows "_" between digits
    except (InvalidOperation, ValueError):
        return None
    places = 0 if text.isdecimal() and len(text) >= NANOSECOND_DIGITS else 9
    is_time = stamp.is_finite() and 0 <= stamp < _MAX_STAMP_NS // 10**places
    return int(stamp.scaleb(places)) if is_time else None


def _numbers_of(path: Path) -> list[tuple[int, str]]:
    """Return a key that sorts names by the numbers in them: 9.png comes before 10.png."""
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in re.split(r"(\d+)", path.name)]


def _read_regular(path: Path, most_bytes: int) -> bytes:
    """Return the first bytes of a file. Raise OSError for anything but a file; a pipe is not waited for."""
    with open(os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC), "rb") as file:
        if not stat.S_ISREG(os.fstat(file.fileno()).st_mode):
            raise OSError(errno.EINVAL, "it is no regular file")
        return file.read(most_bytes)
