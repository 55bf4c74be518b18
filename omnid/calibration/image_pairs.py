"""Pairs of images of two cameras: lower_*, upper_* of a folder, or the pairs of a log."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing, suppress
from dataclasses import dataclass, replace
from pathlib import Path

from calib.rig import Rig
from drivers.errors import DriverError, FrameDecodeError
from drivers.frame import Frame, gray
from drivers.logs.image_folder import IMAGE_SUFFIXES
from drivers.logs.log_reader import LogReader
from omnid.calibration.images import (
    Image,
    Images,
    is_log,
    one_size,
    read_images,
    repeat_notes,
    repeats,
)
from omnid.errors import OmnidError

SIDES = ("lower", "upper")
# Largest difference between the stamps of a pair: boards are held still, so that 10 ms show the same instant.
TOLERANCE_NS = 10_000_000
# Number of pairs of a log that are used, evenly spread: a board held by hand moves little between two of them.
LOG_PAIRS = 100


@dataclass(frozen=True, slots=True)
class PairedImages:
    """Images of the lower and the upper camera by the name of the instant; some instants have one camera only."""

    sides: tuple[Images, Images]
    topics: tuple[str, str] = ("", "")
    notes: tuple[str, ...] = ()  # about images that were left out

    @property
    def names(self) -> list[str]:
        """Return the names of all instants, sorted."""
        return sorted({**self.sides[0], **self.sides[1]})


def read_pairs(source: Path, lower: str | None = None, upper: str | None = None) -> PairedImages:
    """Read the images of a folder or a log; lower and upper: a log's topics. Raises OmnidError without any pair."""
    of_log = is_log(source) or (source.is_dir() and any(map(is_log, source.iterdir())))
    if not of_log and (lower or upper):
        raise OmnidError(f"{source}: only a log has topics; found a folder of images")
    pairs = _of_log(source, lower, upper) if of_log else _of_folder(source)
    if not pairs.sides[0].keys() & pairs.sides[1].keys():
        raise OmnidError(
            f"{source}: no pair of images: found {_counted(pairs)}; expected pairs like lower_001.png "
            "and upper_001.png in a folder, or images with nearly equal stamps in a log"
        )
    return _each_once(pairs)


def _each_once(pairs: PairedImages) -> PairedImages:
    """Return the pairs without those whose images are all the same as those of an earlier pair."""
    repeated = repeats(pairs.sides)
    lower, upper = ({name: image for name, image in side.items() if name not in repeated} for side in pairs.sides)
    return replace(pairs, sides=(lower, upper), notes=repeat_notes(repeated))


def _counted(pairs: PairedImages) -> str:
    return ", ".join(f"{len(side)} of the {name} camera" for name, side in zip(SIDES, pairs.sides, strict=True))


def _of_folder(folder: Path) -> PairedImages:
    if not folder.is_dir():
        raise OmnidError(
            f"{folder}: expected a log (.mcap, .db3, .bag) or a folder with images lower_*, upper_*; "
            f"found {'a file' if folder.exists() else 'no such file or folder'}"
        )
    lower, upper = (_of_side(folder, side) for side in SIDES)
    return PairedImages((lower, upper))


def _of_side(folder: Path, side: str) -> Images:
    paths = sorted(path for path in folder.glob(f"{side}_*") if path.suffix.lower() in IMAGE_SUFFIXES)
    if not paths:
        raise OmnidError(f"{folder}: no images {side}_* in this folder; name them lower_001.png, upper_001.png ...")
    first = dict[str, Path]()
    for path in paths:
        if (other := first.setdefault(path.stem, path)) != path:
            raise OmnidError(f"{folder}: {other.name} and {path.name} have one name; remove or rename one of them")
    found = read_images([str(path) for path in paths])
    return {Path(name).stem.removeprefix(f"{side}_"): image for name, image in found.items()}


def _of_log(log: Path, lower: str | None, upper: str | None) -> PairedImages:
    with closing(LogReader(log, lower, upper)) as reader:
        stride = max(1, sum(1 for _ in paired(reader.frames())) // LOG_PAIRS)
        pairs = [_decoded(pair) for number, pair in enumerate(paired(reader.frames())) if number % stride == 0]
        topics = reader.topics
    named = {f"pair{number * stride:05d}": pair for number, pair in enumerate(pairs) if pair}
    sides = [{name: pair[side] for name, pair in named.items()} for side in (0, 1)]
    for images in sides:
        one_size(images)
    return PairedImages((sides[0], sides[1]), (topics["lower"], topics["upper"]))


def _decoded(pair: tuple[Frame, Frame]) -> tuple[Image, Image] | None:
    try:
        return gray(pair[0]), gray(pair[1])
    except FrameDecodeError:
        return None


def paired(frames: Iterator[Frame], tolerance_ns: float = TOLERANCE_NS) -> Iterator[tuple[Frame, Frame]]:
    """Yield pairs of lower and upper frames with nearly equal stamps, from frames in order of stamps, undecoded."""
    waiting: Frame | None = None
    for frame in frames:
        if waiting and waiting.camera != frame.camera and frame.stamp_ns - waiting.stamp_ns <= tolerance_ns:
            yield (waiting, frame) if frame.camera == "upper" else (frame, waiting)
            waiting = None
        else:
            waiting = frame


def open_log(log: Path, topics: tuple[str | None, str | None], rig: Rig | None) -> LogReader:
    """Open the log's two cameras: by the requested topics, by the rig's if the log has them, or by their names."""
    rig_topics = rig.topics if rig else ("", "")
    named = [requested or known or None for requested, known in zip(topics, rig_topics, strict=True)]
    if rig and not any(topics):
        with suppress(DriverError):
            return LogReader(log, *named)
    return LogReader(log, *topics)
