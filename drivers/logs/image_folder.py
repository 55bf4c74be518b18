"""Folders of images, one folder for each camera.

When an image was taken is stated in one of two ways:

1. times.txt or timestamps.txt in the folder of the images or the one above: a line with a stamp for each image, in the
   natural order of their names: seconds, or nanoseconds of 16 to 19 digits;
2. its name: nanoseconds of 16 to 19 digits as of EuRoC (1403636579763555584.png), or seconds with a decimal point as of
   TUM.
"""

from __future__ import annotations

import os
import re
from collections.abc import Sequence
from contextlib import suppress
from decimal import Decimal
from pathlib import Path
from typing import Final

import numpy as np

from drivers.errors import DriverError, RecordError
from drivers.logs.log import ENTRY, LATEST_NS, MAX_RECORD_BYTES, Entries, LogFile, Topic
from drivers.logs.ros_messages import COMPRESSED_IMAGE, compressed_image

SUFFIXES: Final = (".png", ".jpg", ".jpeg")
# Images of boards, which OpenCV reads; those of a log have one of SUFFIXES.
IMAGE_SUFFIXES: Final = frozenset({*SUFFIXES, ".bmp", ".pgm", ".ppm", ".tif", ".tiff", ".webp"})
ATTACHMENT: Final = "rig.toml"  # The rig's file, in the same folder as the folders of the cameras.
STAMP_LISTS: Final = ("times.txt", "timestamps.txt")
_NANOSECONDS: Final = re.compile(r"\d{16,19}")


def image_folders(path: Path) -> list[Path]:
    """Return the folders with images below a folder."""
    below = sorted(os.walk(path))
    return [Path(folder) for folder, _, files in below if Path(folder) != path and any(map(_is_image, files))]


def _is_image(name: str) -> bool:
    """True for the name of an image; hidden files such as ._1.png are of macOS."""
    return Path(name).suffix.lower() in SUFFIXES and not name.startswith(".")


class ImageFolder(LogFile):
    """A LogFile of folders of images; the topic of each is its path below the given folder.

    Raises DriverError where an image has no stamp.
    """

    def __init__(self, path: Path, folders: Sequence[Path]) -> None:
        super().__init__(path)
        self._path = path
        self._images: list[tuple[int, int, Path]] = []  # folder, stamp [ns], file
        for number, folder in enumerate(folders):
            self._images += ((number, stamp_ns, image) for stamp_ns, image in sorted(_stamped(folder)))
            self.topics[number] = Topic(folder.relative_to(path).as_posix(), COMPRESSED_IMAGE)

    def entries(self) -> Entries:
        """Return the places of the images."""
        return np.array([(f, ns, ns, 0, number) for number, (f, ns, _) in enumerate(self._images)], ENTRY)

    def read(self, channel: int, block: int, offset: int) -> bytes:
        """Return an image as a message, whose stamp is that of the image; raise RecordError where it is unreadable."""
        _, stamp_ns, path = self._images[offset]
        try:
            if path.stat().st_size > MAX_RECORD_BYTES:
                raise RecordError(f"{str(path)!r} has more than {MAX_RECORD_BYTES} bytes")
            return compressed_image(stamp_ns, path.read_bytes())
        except OSError as error:
            raise RecordError(f"{str(path)!r} cannot be read: {error.strerror}") from error

    def attachments(self) -> dict[str, bytes]:
        """Return the rig.toml in the folder of the folders, if there is one."""
        rig = self._path / ATTACHMENT
        return {ATTACHMENT: rig.read_bytes()} if rig.is_file() else {}

    def close(self) -> None:
        """Do nothing: no file is kept open."""


def _stamped(folder: Path) -> list[tuple[int, Path]]:
    """Return stamp [ns] and path of the images of a folder; raise DriverError where one has no stamp."""
    paths = sorted((path for path in folder.iterdir() if _is_image(path.name) and path.is_file()), key=_numbers_of)
    # A whole number of fewer digits is no time.
    texts = [path.stem if "." in path.stem or _NANOSECONDS.fullmatch(path.stem) else "" for path in paths]
    lists = [file for place in (folder, folder.parent) for name in STAMP_LISTS if (file := place / name).is_file()]
    if lists:
        try:
            with lists[0].open("rb") as stamps:
                text = stamps.read(MAX_RECORD_BYTES).decode("utf-8-sig", "replace")
        except OSError as error:
            raise DriverError(f"cannot read the stamps {str(lists[0])!r}: {error.strerror}") from error
        texts = [line for each in text.splitlines() if (line := each.strip()) and not line.startswith("#")]
        if len(texts) != len(paths):
            raise DriverError(
                f"{str(folder)!r} contains {len(paths)} images, and its list of stamps {len(texts)} lines: "
                "they must be as many"
            )
    return [(_stamp_ns(text, path), path) for text, path in zip(texts, paths, strict=True)]


def _stamp_ns(text: str, image: Path) -> int:
    """Return a stamp, exactly: see the head of this file; raise DriverError for another text."""
    with suppress(ArithmeticError, ValueError):
        stamp_ns = Decimal(text) * (1 if _NANOSECONDS.fullmatch(text) else 10**9)
        if 0 <= stamp_ns < LATEST_NS and "_" not in text:
            return int(stamp_ns)
    raise DriverError(
        f"{str(image)!r} has no stamp: expected as its name nanoseconds of 16 to 19 digits, or seconds with a decimal "
        f"point; or a line for each image with its seconds in {STAMP_LISTS[0]}"
    )


def _numbers_of(path: Path) -> list[tuple[int, str]]:
    """Return a key that sorts names by the numbers in them: 9.png comes before 10.png."""
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in re.split(r"(\d+)", path.name)]
