"""Comparison of the outputs of replays before and after a change: `python -m tests.bench.same_bytes COMMAND DIR`.

`record` renders short logs into DIR/logs where they are missing, replays each one inline, keeps the outputs in
DIR/outputs and their digests in DIR/digests.json. `compare` replays the same logs and prints the outputs that differ as
JSON, trajectories with the largest difference of their numbers; the exit code is 1 where one differs.

Outputs are the trajectories in odom and in the map, the cloud, the plan, and the messages of each recorded topic. The
topic of the status is left out: it holds times of computation.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import subprocess
import sys
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from mcap.reader import make_reader

from drivers.motion import MotionSample, WheelSample
from omnid.formats.tum import read_tum
from omnid.transport.sensor_codec import gyro_cdr, wheel_cdr
from tests.drivers.logs.mcap_logs import COMPRESSED, LOWER, UPPER, Entry, compressed, write_log
from tests.replay.edited import dark, images
from tests.simulation.motion_samples import SensorErrors, motion_samples

Digests = dict[str, str]  # name of an output -> SHA-256

ROOT = Path(__file__).parents[2]
# The folder `shared` lies next to the repository or above it.
DATA = next((path / "shared" / "data" for path in ROOT.parents if (path / "shared").is_dir()), ROOT / "shared")
FILES = {"--tum": "odom.txt", "--map-tum": "map.txt", "--cloud": "cloud.ply", "--plan": "plan.png"}
RECORDING = "recording.mcap"
TIMED_TOPIC = "/omnid/status"
DARK_PAIRS = range(12, 18)  # less than a second, which wheels and gyro bridge
SENSOR_ERRORS = SensorErrors(distance=1.02, turn=0.97, wheel_offset_s=0.01, bias_radps=(0.0, 0.0, 0.01))


@dataclass(frozen=True, slots=True)
class Log:
    """A log that is replayed: a recipe of `python -m tests.simulation`, or a file at hand."""

    recipe: str = ""  # its arguments without the folder; empty: the file is at hand
    path: Path | None = None
    rig: str = ""  # file beside the log; empty: attached to it
    options: tuple[str, ...] = ()  # of `omnid replay`


SMALL = "--size 384"
LOGS = {
    "sample": Log(path=ROOT / "omnid" / "sample" / "log.mcap"),
    "two_walls": Log(path=DATA / "two_walls" / "log.mcap", rig="camchain.yaml"),
    "two_walls_crooked": Log(path=DATA / "two_walls_crooked" / "log.mcap", rig="camchain.yaml"),
    "paper": Log(path=ROOT / "omnid" / "sample" / "log.mcap", options=("--method", "paper", "--seconds", "3")),
    "turns": Log(f"turns --seed 3 {SMALL}"),
    "misaligned": Log(f"misaligned --seed 4 --pairs 20 {SMALL}"),
    "struts": Log(f"struts --seed 5 --pairs 30 {SMALL}"),
    "rooms": Log(f"rooms --seed 6 --pairs 40 {SMALL}"),
    "skewed": Log(f"two_walls --seed 7 --pairs 25 --speed 1.4 --skew-ms 15 {SMALL}"),
    "rolling": Log(f"rooms --seed 8 --pairs 25 --line-time-us 52 {SMALL}"),
    "bridged": Log(f"rooms --seed 9 --pairs 30 {SMALL}"),
}


def ensure_logs(folder: Path) -> None:
    """Render the logs that are missing in a folder."""
    for name, log in LOGS.items():
        target = folder / name
        if log.recipe and not (target / "log.mcap").exists():
            command = [sys.executable, "-m", "tests.simulation", *log.recipe.split(), "--out", str(target)]
            subprocess.run(command, cwd=ROOT, check=True)
            if name == "bridged":
                add_wheels_and_gyro(target)


def add_wheels_and_gyro(folder: Path) -> None:
    """Add samples of wheels and gyro to a rendered log, and darken the images of DARK_PAIRS."""
    truth, path = read_tum(folder / "truth.txt"), folder / "log.mcap"
    topics = {"lower": LOWER, "upper": UPPER}
    taken = [dark(image) if image.pair in DARK_PAIRS else image for image in images(path)]
    entries = [Entry(topics[p.camera], COMPRESSED, compressed(p.stamp_ns, p.jpeg), p.written_ns) for p in taken]
    entries += [_entry(sample) for sample in motion_samples(truth.stamps_ns, truth.T, SENSOR_ERRORS, seed=1)]
    write_log(path, sorted(entries, key=lambda entry: entry.log_time_ns))


def _entry(sample: MotionSample) -> Entry:
    if isinstance(sample, WheelSample):
        return Entry(
            "/base/wheel_odometry", "nav_msgs/msg/Odometry", wheel_cdr(sample, sample.stamp_ns), sample.stamp_ns
        )
    return Entry("/imu/data", "sensor_msgs/msg/Imu", gyro_cdr(sample, sample.stamp_ns), sample.stamp_ns)


def replay(name: str, logs: Path, outputs: Path) -> Digests:
    """Replay a log inline into a folder; return the digests of its outputs."""
    log = LOGS[name]
    path = log.path or logs / name / "log.mcap"
    rig = path.with_name(log.rig or ("rig.toml" if log.recipe else "-"))
    if rig.suffix == ".yaml":
        rig = imported(rig, outputs)
    outputs.mkdir(parents=True, exist_ok=True)
    files = [word for option, file in FILES.items() for word in (option, str(outputs / file))]
    command = [
        sys.executable,
        "-P",
        "-m",
        "omnid",
        "replay",
        str(path),
        "--inline",
        "--quiet",
        *files,
        *log.options,
        "--record",
        str(outputs / RECORDING),
        *(["--rig", str(rig)] if rig.exists() else []),
    ]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise SystemExit(f"{name}: {done.stderr.strip() or done.stdout.strip()}")
    digests = {
        file: hashlib.sha256((outputs / file).read_bytes()).hexdigest()
        for file in FILES.values()
        if (outputs / file).exists()
    }
    return digests | topic_digests(outputs / RECORDING)


def imported(camchain: Path, folder: Path) -> Path:
    """Return the rig.toml of a Kalibr file, written into a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    rig = folder / "rig.toml"
    rig.unlink(missing_ok=True)
    subprocess.run(
        [sys.executable, "-P", "-m", "omnid", "calibrate", "import", str(camchain), "-o", str(rig)],
        cwd=ROOT,
        check=True,
        capture_output=True,
    )
    return rig


def topic_digests(recording: Path) -> Digests:
    """Return the digest of the messages of each topic of a recording, stamps and bytes, without TIMED_TOPIC."""
    found: dict[str, hashlib._Hash] = {}
    with recording.open("rb") as file:
        for _, channel, message in make_reader(file).iter_messages():
            if channel.topic != TIMED_TOPIC:
                digest = found.setdefault(channel.topic, hashlib.sha256())
                digest.update(message.log_time.to_bytes(8, "little") + message.data)
    return {topic: digest.hexdigest() for topic, digest in sorted(found.items())}


def largest_difference(before: Path, after: Path) -> float:
    """Return the largest difference of a number of two trajectories; infinite where their rows differ."""
    a, b = read_tum(before), read_tum(after)
    if a.stamps_ns.shape != b.stamps_ns.shape or (a.stamps_ns != b.stamps_ns).any():
        return float("inf")
    return float(np.abs(a.T - b.T).max())


def record(folder: Path, names: Iterable[str]) -> int:
    """Keep outputs and digests of the logs."""
    path = folder / "digests.json"
    digests = json.loads(path.read_text("utf-8")) if path.exists() else {}
    for name in names:
        digests[name] = replay(name, folder / "logs", folder / "outputs" / name)
        path.write_text(json.dumps(digests, indent=1) + "\n", "utf-8")
        print(f"{name}: {len(digests[name])} outputs", file=sys.stderr, flush=True)
    return 0


def compare(folder: Path, names: Iterable[str]) -> int:
    """Print what differs from the outputs that were recorded; return 1 if anything does."""
    recorded: dict[str, Digests] = json.loads((folder / "digests.json").read_text("utf-8"))
    different: dict[str, dict[str, object]] = {}
    with TemporaryDirectory() as work:
        for name in names:
            outputs = Path(work) / name
            now, before = replay(name, folder / "logs", outputs), recorded[name]
            changed: dict[str, object] = {
                each: "differs" for each in sorted(now.keys() | before.keys()) if now.get(each) != before.get(each)
            }
            for file in changed.keys() & {"odom.txt", "map.txt"}:
                changed[file] = largest_difference(folder / "outputs" / name / file, outputs / file)
            if changed:
                different[name] = changed
            print(f"{name}: {len(now)} outputs, {len(changed)} differ", file=sys.stderr, flush=True)
    print(json.dumps({"different": different}, indent=1))
    return int(bool(different))


def main() -> int:
    """Record or compare."""
    parser = argparse.ArgumentParser(
        prog="python -m tests.bench.same_bytes",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("command", choices=("record", "compare"))
    parser.add_argument("folder", type=Path, metavar="DIR")
    parser.add_argument(
        "--only",
        nargs="+",
        choices=sorted(LOGS),
        default=list(LOGS),
        metavar="LOG",
        help=f"these logs: {', '.join(LOGS)}",
    )
    args = parser.parse_args()
    names = [name for name in args.only if LOGS[name].path is None or LOGS[name].path.exists()]
    if args.command == "compare":
        return compare(args.folder, names)
    ensure_logs(args.folder / "logs")
    return record(args.folder, names)


if __name__ == "__main__":
    sys.exit(main())
