"""Mutated files and messages against their parsers, in a process of limited memory: a result, or one clear error.

`python -m tests.bench.faults.hostile_files FORMAT FOLDER FILES SEED` is that process; it prints the files that did not
hold.
"""

from __future__ import annotations

import random
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from types import FrameType
from typing import Final, NamedTuple

import numpy as np

from calib.errors import CalibError
from calib.importers import parse_chain, parse_ocam
from calib.rig_file import parse_rig
from drivers.errors import DriverError
from drivers.frame import gray
from drivers.logs.log_reader import LogReader
from omnid.config import Config, load_config
from omnid.errors import OmnidError
from omnid.formats.place_file import read_places, write_places
from omnid.formats.tum import read_tum
from omnid.settings import dump
from omnid.transport import codec
from omnid.transport.codec import DiagnosticStatus, PoseAttachment, decode_diagnostics, decode_pose
from tests.bench.faults.mutation import mutated
from tests.bench.results import ResultTable, columns
from tests.calib.test_importers import BOTH, NAMED, T_UPPER_LOWER, chain
from tests.drivers.logs.mcap_logs import pairs, write_bag, write_db3
from tests.omnid.formats.place_maps import RIG, some_places
from tests.simulation import build, write_log

ROOT: Final = Path(__file__).parents[3]
MEMORY_BYTES: Final = 1 << 30  # of address space: numpy, OpenCV and zenoh take about half of it
LONGEST_S: Final = 10.0  # for one file
MOST_FAILURES: Final = 5
EXPECTED: Final = (CalibError, DriverError, OmnidError)
COLUMNS: Final = columns("mutated files", "number", "most memory|MB", "time|s|0", "result")
OCAM: Final = b"4 -200 0 1e-3 1e-7\n3 1 2 3\n240 320\n1 0 0\n480 640\n"


class Format(NamedTuple):
    """A file format: a good file from a folder with a short rendered run, and its parser."""

    good: Callable[[Path], bytes]
    parse: Callable[[Path], object]


class TooLongError(Exception):
    """A file took too long."""


def read_frames(path: Path) -> None:
    """Read a log of any format as a replay does."""
    reader = LogReader(path)
    try:
        reader.attachments()
        for frame in reader.frames():
            try:
                gray(frame)
            except DriverError:
                continue
    finally:
        reader.close()


def messages() -> Mapping[str, bytes]:
    """Return a message of each kind that clients decode."""
    status = DiagnosticStatus("omnid: wheels", 1, "no command", {"commands": "4", "armed": "1"})
    return {
        "odom": codec.odometry_cdr(10**18, np.eye(4), np.eye(6), np.arange(6.0), np.eye(6)),
        "status": codec.diagnostics_cdr(10**18, [status] * 5),
    }


def map_bytes(folder: Path) -> bytes:
    """Return a map of places."""
    write_places(folder / "good.omap", some_places(4, features=8), RIG)
    return (folder / "good.omap").read_bytes()


FORMATS: Final = {
    "rig.toml": Format(lambda folder: (folder / "rig.toml").read_bytes(), lambda path: parse_rig(path.read_bytes())),
    "camchain.yaml": Format(
        lambda _: chain(BOTH, T_UPPER_LOWER, NAMED).encode(),
        lambda path: parse_chain(path.read_text(errors="replace")),
    ),
    "calib_results.txt": Format(lambda _: OCAM, lambda path: parse_ocam(path.read_text(errors="replace"))),
    "omnid.toml": Format(lambda _: dump(Config()).encode(), load_config),
    "place.omap": Format(map_bytes, read_places),
    "truth.txt": Format(lambda folder: (folder / "truth.txt").read_bytes(), read_tum),
    "log.mcap": Format(lambda folder: (folder / "log.mcap").read_bytes(), read_frames),
    "log.db3": Format(lambda folder: write_db3(folder / "bag", pairs(4)).read_bytes(), read_frames),
    "log.bag": Format(lambda folder: write_bag(folder / "log.bag", pairs(4), "LZ4").read_bytes(), read_frames),
    "odom.cdr": Format(lambda _: messages()["odom"], lambda path: decode_pose(path.read_bytes(), b"")),
    "status.cdr": Format(lambda _: messages()["status"], lambda path: decode_diagnostics(path.read_bytes())),
    "attachment.json": Format(
        lambda _: PoseAttachment(7, "tracking", 0, 50, 60, 10**18).to_bytes(),
        lambda path: PoseAttachment.from_bytes(path.read_bytes()),
    ),
}


def too_long(_: int, __: FrameType | None) -> None:
    """Interrupt a parser."""
    raise TooLongError(f"longer than {LONGEST_S:g} s")


def failures(name: str, folder: Path, count: int, seed: int) -> list[str]:
    """Parse mutated files; return a line for each that did not hold, at most MOST_FAILURES."""
    form, path, found = FORMATS[name], folder / f"mutated-{name}", list[str]()
    good = form.good(folder)
    path.write_bytes(good)
    form.parse(path)
    for number in range(count):
        path.write_bytes(mutated(random.Random(f"{name} {seed} {number}"), good))
        signal.setitimer(signal.ITIMER_REAL, LONGEST_S)
        try:
            form.parse(path)
        except EXPECTED as error:
            if "\n" in str(error):
                found.append(f"{name} {number}: more than one line: {error}")
        except Exception as error:
            found.append(f"{name} {number}: {type(error).__name__}: {error}")
        finally:
            signal.setitimer(signal.ITIMER_REAL, 0)
        if len(found) >= MOST_FAILURES:
            break
    return found


def limited_main(names: str, folder: str, count: str, seed: str) -> int:
    """Attack parsers in this process, whose memory is limited; print the failures and the largest memory.

    names: one, or several with commas between them.
    """
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY_BYTES, MEMORY_BYTES))
    signal.signal(signal.SIGALRM, too_long)
    with np.errstate(all="ignore"):
        found = [line for name in names.split(",") for line in failures(name, Path(folder), int(count), int(seed))]
    status = Path("/proc/self/status").read_text()  # not ru_maxrss, which contains the parent of this process
    print(int(status.split("VmHWM:")[1].split()[0]) // 1024)
    for line in found:
        print(line[:300].replace("\n", " "))
    return int(bool(found))


def attack(name: str, folder: Path, count: int, seed: int) -> tuple[int, list[str]]:
    """Attack parsers, as limited_main, in a process of its own; return its largest memory [MB] and the failures."""
    command = [sys.executable, "-m", __name__, name, str(folder), str(count), str(seed)]
    done = subprocess.run(
        command,
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
        env={"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"},
    )
    first, *found = done.stdout.splitlines() or ["0"]
    if done.returncode not in (0, 1) or (done.returncode == 1 and not found):
        found.append(f"{name}: the process ended with {done.returncode}: {done.stderr[-300:]}")
    return int(first), found


def short_run(folder: Path) -> Path:
    """Render three pairs into the folder."""
    run = build("two_walls", seed=3, size=128, pairs=3)
    write_log(folder, run.rig, run.poses, run.scene, sensor=run.sensor, seed=3)
    return folder


def run(folder: Path, count: int, seed: int) -> int:
    """Measure a row for each format; return the number of formats that did not hold."""
    short_run(folder / "short")
    failed = 0
    table = ResultTable("faults_files", "Mutated files", COLUMNS)
    for name in FORMATS:
        begin_s = time.monotonic()
        memory_mb, found = attack(name, folder / "short", count, seed)
        failed += bool(found)
        table.add(name, count, memory_mb, time.monotonic() - begin_s, "; ".join(found) or "a result or one line, each")
    return failed


if __name__ == "__main__":
    sys.exit(limited_main(*sys.argv[1:5]))
