"""Reads the frames of two cameras from an MCAP log as `ros2 bag record -s mcap` writes it, complete or damaged."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace

from drivers.errors import DriverError, FrameDecodeError
from drivers.frame import Camera, Frame
from drivers.logs.mcap_catalog import Catalog
from drivers.logs.mcap_index import has_footer, read_attachments, read_summary
from drivers.logs.mcap_messages import DataSection, LogMessage, scan_channels
from drivers.logs.mcap_records import LogFile, RecordError
from drivers.logs.reorder_buffer import ReorderBuffer
from drivers.logs.ros_image import COMPRESSED_IMAGE, IMAGE, RosImage, parse_image
from drivers.logs.topic_choice import choose_topics

_SCAN_BYTES = 64 * 2**20
_SCAN_MESSAGES = 2000
_WARNINGS = {
    "late": "dropped {} frames older than others read before: record with less delay or raise log.reorder_frames",
    "duplicate": "dropped {} frames with the same stamp as the frame before of the same camera",
    "broken": "skipped {} messages of the cameras' topics that hold no valid image; the first: {fault}",
    "unstamped": "{} frames have no stamp in their header: used the time of logging",
    "broken_records": "skipped {} corrupt chunks or records of the file",
}
_COUNTERS = ("lower", "upper", *_WARNINGS)


class LogReader:
    """A FrameSource that streams a log once per call of frames(), without the log's index.

    path: the .mcap file, or the folder that `ros2 bag record` made. lower, upper: topics, where their names do not
    identify the cameras. window: number of frames that are held back to sort them by stamp. Raises DriverError where
    the path is no such log, or the topics of the two cameras are ambiguous.

    During and after frames(), `counts` has 'lower' and 'upper' (frames delivered), 'late', 'duplicate', 'unstamped'
    (log time used), 'broken' (messages without a valid image) and 'broken_records' (chunks or records of the file).
    After its end `truncated` is True for an incomplete file, and `warnings` has one line per kind of fault.
    """

    def __init__(
        self, path: str | os.PathLike[str], lower: str | None = None, upper: str | None = None, *, window: int = 32
    ) -> None:
        self._window = window
        self._file = LogFile(path)
        self._reset()
        try:
            self._summary = read_summary(self._file)
            self._catalog = self._known_channels()
            wanted: dict[Camera, str | None] = {"lower": lower, "upper": upper}
            self._cameras = choose_topics(repr(str(self._file.path)), self._catalog.topics(), wanted)
        except DriverError:
            self.close()
            raise

    @property
    def topics(self) -> dict[Camera, str]:
        """The topic of each camera."""
        return {camera: topic for topic, camera in self._cameras.items()}

    def frames(self) -> Iterator[Frame]:
        """Yield the frames of both cameras in the order of their stamps; seq counts each camera's from 0."""
        self._reset()
        section = DataSection(self._file, self._catalog)
        buffer = ReorderBuffer(self._window, self.counts)
        for message in section.messages():
            found = self._image(message)
            if found is not None:
                camera, image = found
                yield from buffer.push(camera, image)
            if self._file.closed:
                return
        yield from buffer.drain()
        self._report(section)

    def close(self) -> None:
        """End frames() and close the file."""
        self._file.close()

    def pair_estimate(self) -> int | None:
        """Return the largest possible number of pairs, for a progress bar; None without statistics in the file."""
        if self._summary is None or not self._summary.message_counts:
            return None
        catalog, counts = self._summary.catalog, self._summary.message_counts
        return min(sum(counts.get(channel, 0) for channel in catalog.ids(topic)) for topic in self._cameras)

    def attachments(self) -> dict[str, bytes]:
        """Return name -> bytes of the attachments, such as a rig; at most 32 of up to 16 MiB each, 64 MiB in all."""
        return read_attachments(self._file, self._summary)

    def _reset(self) -> None:
        self.counts: Counter[str] = Counter(dict.fromkeys(_COUNTERS, 0))
        self.warnings: list[str] = []
        self.truncated = False
        self._fault = ""  # of the first message without a valid image

    def _known_channels(self) -> Catalog:
        """Return the channels from the summary; of a truncated log, which has none, from the start of the file."""
        if self._summary is not None and self._summary.catalog.topics():
            return self._summary.catalog
        return scan_channels(self._file, _SCAN_BYTES, _SCAN_MESSAGES)

    def _image(self, message: LogMessage) -> tuple[Camera, RosImage] | None:
        """Return camera and image of a message, None of other topics and broken images.

        The image is copied out of its chunk, so that a frame that is held back does not keep the chunk in memory.
        """
        topic = self._catalog.topic(message.channel_id)
        if topic is None or topic.name not in self._cameras or topic.type not in (IMAGE, COMPRESSED_IMAGE):
            return None
        try:
            image = parse_image(topic.type, message.data())
        except (FrameDecodeError, RecordError) as error:
            self.counts["broken"] += 1
            self._fault = self._fault or str(error)
            return None
        self.counts["unstamped"] += not image.stamp_ns
        stamp_ns = image.stamp_ns or message.log_time_ns
        return self._cameras[topic.name], replace(image, stamp_ns=stamp_ns, data=memoryview(bytes(image.data)))

    def _report(self, section: DataSection) -> None:
        self.counts["broken_records"] = section.broken
        self.truncated = not (section.ended and has_footer(self._file))
        if self.truncated:
            self.warnings.append(
                f"the log {str(self._file.path)!r} is cut or corrupt after byte {section.position} of "
                f"{self._file.size}: used the data before"
            )
        found = {name: text for name, text in _WARNINGS.items() if self.counts[name]}
        self.warnings += [text.format(self.counts[name], fault=self._fault) for name, text in found.items()]
