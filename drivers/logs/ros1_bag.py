"""Bags of ROS 1 (.bag), whose index is read by rosbags: one that was cut must be repaired by `rosbag reindex`."""

from __future__ import annotations

import os
from functools import lru_cache
from pathlib import Path
from struct import Struct
from typing import Final

import numpy as np
from rosbags.rosbag1 import Reader

from drivers.errors import DriverError, RecordError, one_line
from drivers.logs.log import ENTRY, KEPT_CHUNKS, Entries, LogFile, Topic

_LENGTH: Final = Struct("<I")  # of the head of a record, and of its data, before each (wiki.ros.org/Bags/Format/2.0)


class Ros1Bag(LogFile):
    """A LogFile of one .bag file; raises DriverError where it cannot be read."""

    magic = b"#ROSBAG V2.0\n"

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self._bag = Reader(path)
        try:
            self._bag.open()
            self._file = path.open("rb", buffering=0)
        except Exception as error:  # of any kind, as it trusts the lengths in the bytes
            reason = f"{one_line(error)}; if its recorder was stopped, try `rosbag reindex`"
            raise DriverError(f"cannot read the bag {self.name!r}: {reason}") from error
        for of in self._bag.connections:
            self.topics[of.id] = Topic(of.topic, of.msgtype, aligned=False)
        self._chunk = lru_cache(KEPT_CHUNKS)(self._unpacked)

    def entries(self) -> Entries:
        """Return the places of all messages by the index, chunk by chunk."""
        places = (
            (place.chunk_pos, place.offset, channel, place.time)
            for channel, found in self._bag.indexes.items()
            for place in found
        )
        found = []
        for block, offset, channel, time_ns in sorted(places):
            try:
                found.append((channel, time_ns, self.header_ns(channel, self.read(block, offset)), block, offset))
            except RecordError as error:
                self.faults.setdefault(block, str(error))
        return np.array(found, ENTRY)

    def read(self, block: int, offset: int) -> memoryview:
        """Return the bytes of the message of an entry; raise RecordError where they are not those that were written."""
        data = self._chunk(block)
        for _ in ("head", "data"):
            size = int.from_bytes(data[offset : offset + _LENGTH.size], "little")
            begin, offset = offset + _LENGTH.size, offset + _LENGTH.size + size
        if not begin < offset <= len(data):
            raise RecordError(f"the chunk at byte {block}: the message at its byte {offset} is not whole")
        return data[begin:offset]

    def _unpacked(self, block: int) -> memoryview:
        """Return the content of a chunk; raise RecordError where it does not unpack."""
        chunk = self._bag.chunks[block]
        try:
            return memoryview(chunk.decompressor(os.pread(self._file.fileno(), chunk.datasize, chunk.datapos)))
        except Exception as error:  # of any kind that a decompressor or a closed file raises
            raise RecordError(f"the chunk at byte {block}: it does not unpack") from error

    def close(self) -> None:
        """Close the file; may be called twice."""
        if not self._file.closed:
            self._file.close()
            self._bag.close()
