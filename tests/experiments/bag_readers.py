"""Readers of bags, those of rosbags against ours, on damaged files: `python -m tests.experiments.bag_readers`.

A ROS 1 bag of 40 messages is read whole, cut in half, and with some bytes changed; an SQLite bag of ROS 2 whose pages
are named again and again (tests/drivers/logs/repeated_pages.py) in a process that is ended after LIMIT_S.
"""

from __future__ import annotations

import random
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Final

from rosbags.rosbag1 import Reader

from drivers.logs.ros1_bag import Ros1Bag
from tests.drivers.logs.bags import write_bag, write_db3
from tests.drivers.logs.mcap_logs import COMPRESSED, LOWER, START_NS, Entry, pairs
from tests.drivers.logs.repeated_pages import repeat_pages

FILES: Final = 400
LIMIT_S: Final = 60.0
READ_ALL: Final = """
import sys
from rosbags.rosbag2 import Reader
with Reader(sys.argv[1]) as reader:
    print(sum(1 for _ in reader.messages()))
"""


def by_rosbags(path: Path) -> int:
    """Return the number of messages that rosbags reads."""
    with Reader(path) as reader:
        return sum(1 for _ in reader.messages())


def by_omnid(path: Path) -> int:
    """Return the number of messages that our reader reads."""
    with closing(Ros1Bag(path)) as bag:
        return sum(1 for _ in bag.messages())


def changed(data: bytes) -> Iterator[bytes]:
    """Yield the file with 1 to 64 bytes changed, half of them near its beginning."""
    chance = random.Random(1)
    for _ in range(FILES):
        content = bytearray(data)
        for _ in range(chance.choice((1, 1, 4, 64))):
            end = len(content) if chance.random() < 0.5 else min(8192, len(content))
            content[chance.randrange(end)] = chance.randrange(256)
        yield bytes(content)


def outcome(read: Callable[[Path], int], path: Path, whole: int) -> str:
    """Return what became of reading a file."""
    try:
        return "all" if read(path) == whole else "some"
    except Exception as error:  # which ones is the question
        return type(error).__name__


def main() -> None:
    """Print what became of each file."""
    folder = Path(tempfile.mkdtemp())
    data, path = write_bag(folder / "whole.bag", pairs(20), "LZ4").read_bytes(), folder / "changed.bag"
    for read in (by_rosbags, by_omnid):
        begin_s, whole = time.perf_counter(), read(folder / "whole.bag")
        print(f"{read.__name__}: {whole} messages in {1e3 * (time.perf_counter() - begin_s):.2f} ms")
        path.write_bytes(data[: len(data) // 2])
        print(f"  cut in half: {outcome(read, path, whole)}")
        found: Counter[str] = Counter()
        for content in changed(data):
            path.write_bytes(content)
            found[outcome(read, path, whole)] += 1
        print(f"  {FILES} with bytes changed: {dict(found)}")
    repeat_pages(write_db3(folder / "bag", [Entry(LOWER, COMPRESSED, b"\0\1\0\0", START_NS)] * 8))
    try:
        subprocess.run([sys.executable, "-c", READ_ALL, str(folder / "bag")], timeout=LIMIT_S, check=False)
    except subprocess.TimeoutExpired:
        print(f"rosbags, pages named again and again: no end after {LIMIT_S:g} s")


if __name__ == "__main__":
    main()
