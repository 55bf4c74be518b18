"""Files that were compressed as a whole, as by `ros2 bag record --compression-mode file` or `gzip`."""

from __future__ import annotations

import bz2
import gzip
import os
import shutil
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import IO, Any, Final

import lz4.frame  # type: ignore[import-untyped]
import zstandard

from drivers.errors import DriverError

PACKED_SUFFIXES: Final = (".zst", ".zstd", ".gz", ".bz2", ".lz4")
_BLOCK_BYTES: Final = 2**20
_FAULTS: Final = (OSError, EOFError, RuntimeError, ValueError, zlib.error, zstandard.ZstdError)


def _zstd(file: IO[bytes]) -> Any:
    return zstandard.ZstdDecompressor().stream_reader(file, read_across_frames=True)


_BY_MAGIC: Final[dict[bytes, Callable[[IO[bytes]], Any]]] = {
    b"\x28\xb5\x2f\xfd": _zstd,
    b"\x1f\x8b": gzip.open,
    b"BZh": bz2.open,
    b"\x04\x22\x4d\x18": lz4.frame.open,
}


def is_packed(start: bytes) -> bool:
    """True if a file with these first bytes was compressed as a whole."""
    return start.startswith(tuple(_BY_MAGIC))


@contextmanager
def scratch_folder(name: str, needed_bytes: int = 0) -> Iterator[Path]:
    """Make a folder on the disk for temporary files: in $TMPDIR, else in /var/tmp.

    Files that are open stay readable when it is removed. Raise DriverError where it cannot be made or is too small.
    """
    place = os.environ.get("TMPDIR") or "/var/tmp"
    try:
        if needed_bytes > shutil.disk_usage(place).free // 2:
            raise _too_small(name, place)
        with TemporaryDirectory(prefix="omnid-", dir=place) as folder:
            yield Path(folder)
    except OSError as error:
        raise DriverError(f"cannot unpack {name!r} in {place!r}: {error.strerror}; set TMPDIR") from error


def unpack(path: Path, folder: Path) -> Path:
    """Unpack a compressed file to a folder, as far as it can be, and return the result.

    It may take half of the free space. Raise DriverError where that is too little.
    """
    target, left = folder / path.name, shutil.disk_usage(folder).free // 2
    with path.open("rb") as file, target.open("wb") as unpacked:
        start = file.read(4)
        file.seek(0)
        stream = next(open_ for magic, open_ in _BY_MAGIC.items() if start.startswith(magic))(file)
        while True:
            try:
                block = stream.read1(_BLOCK_BYTES)  # read() loses what precedes a cut
            except _FAULTS:
                # What follows is cut or corrupt, which the reader of the unpacked log tells.
                break
            if not block:
                break
            left -= len(block)
            if left < 0:
                raise _too_small(str(path), str(folder.parent))
            unpacked.write(block)
    return target


def _too_small(name: str, place: str) -> DriverError:
    return DriverError(f"cannot unpack {name!r}: it takes more than half of the free space of {place!r}; set TMPDIR")
