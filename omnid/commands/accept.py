"""`omnid accept`: the acceptance drive between two marks on the floor."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Final, NamedTuple, TextIO

from omnid.commands.json_output import print_json
from omnid.commands.options import JSON, SETTINGS, command, option, settings_of
from omnid.errors import OmnidError

if TYPE_CHECKING:  # the help does not load these
    import numpy as np
    from numpy.typing import NDArray

    from omnid.formats.tum import Trajectory
    from omnid.recordings.acceptance import Acceptance

# Times above are Unix times, those below count from the first pose.
UNIX_S: Final = 1e8
INSTRUCTIONS: Final = """The acceptance drive
  1. Tape two marks, A and B, on the floor, 10 to 20 m apart, and measure their distance with a tape measure.
  2. Record: `omnid record drive` (stop the daemon first), or `omnid run --set record.enabled=true`.
  3. Place the robot on A, with a point of it that you can find again over the mark, and let it stand for 5 s.
  4. Drive to B, on any way, with the same point over the mark and heading as on A if you can; stand for 5 s.
     Drive back to A, and stand for 5 s. This is a round of 20 to 40 m. Drive three: A B A B A B A.
  5. Run `omnid accept drive --rig rig.toml --distance-m 12.34 -o accept.html`, and send the page; drive is the folder
     of the recording, of `omnid run` that of record.folder.
Where the robot cannot stand: run `omnid accept --keys marks.txt` on the robot while it drives, press Enter each time
the point is over a mark, and give the times as `--marks marks.txt`."""


@command(
    option(
        "log",
        type=Path,
        nargs="?",
        metavar="LOG|TUM",
        help="a log with images, which is replayed, or a trajectory T_odom_rig (.txt, .tum); none: print what to do",
    ),
    option("--distance-m", type=float, metavar="M", help="the distance of the marks by tape measure"),
    option(
        "--marks",
        nargs="+",
        metavar="T",
        help="times on A, B, A ... in s since the first pose or of Unix, or the file of --keys; default: the times at "
        "which the robot stands",
    ),
    option("--keys", type=Path, metavar="FILE", help="write the time of each Enter, until Ctrl-D"),
    option("--rig", type=Path, help="the rig.toml of the cameras; default: that attached to the log"),
    option(
        "--within-percent",
        type=float,
        default=0.5,
        metavar="P",
        help="accepted error of lengths, and of the end of a round against its way; default %(default)s",
    ),
    option("-o", "--output", type=Path, metavar="FILE", help="the page to write"),
    *SETTINGS,
    JSON,
    examples=(
        "accept",
        "accept drive.mcap --rig rig.toml --distance-m 12.34 -o accept.html",
        "accept est.txt --distance-m 12.34 --marks 12.5 60 110",
        "accept --keys marks.txt",
    ),
)
def run(args: argparse.Namespace) -> int:
    """Print the errors and write the page; 1 where the drive is not accepted."""
    from omnid.sinks.files import check_outputs

    if args.keys:
        if args.log is not None:
            raise OmnidError("--keys: expected no log beside it: the marks are used with --marks, after the drive")
        return _write_keys(args.keys, sys.stdin)
    if args.log is None:
        _refuse_without_log(args)
        print(INSTRUCTIONS)
        return 0
    if args.distance_m is None or not 0.1 <= args.distance_m < 1e4:
        raise OmnidError(
            "accept: expected the distance of the marks, of 0.1 m or more, as --distance-m; "
            "`omnid accept` alone prints what to do"
        )
    if not 0 < args.within_percent <= 100:
        raise OmnidError(f"--within-percent {args.within_percent:g}: expected a part above 0 and up to 100")
    outputs = [("--output", args.output)] if args.output else []
    check_outputs(outputs, [("the log that is read", args.log)])
    return _judge(args, _read(args))


def _refuse_without_log(args: argparse.Namespace) -> None:
    """Raise OmnidError for options that need a log: --marks takes all words that follow it, also the name of a log."""
    values = {"--distance-m": args.distance_m, "--marks": args.marks, "-o": args.output, "--json": args.json or None}
    given = [name for name, value in values.items() if value is not None]
    if given:
        raise OmnidError(
            f"accept: expected a log or a trajectory with {' and '.join(given)}, found none; name it first: "
            "omnid accept drive.mcap --distance-m 12.34 --marks 12.5 60 110"
        )


class _Drive(NamedTuple):
    """Poses of a drive: of the odometry, and in the map as they were known while driving (None: no map)."""

    odometry: Trajectory
    in_map: Trajectory | None
    map_xyz: NDArray[np.float32]
    rig_height_m: float  # at the start, in the frame of the poses
    lost: int  # poses


def _read(args: argparse.Namespace) -> _Drive:
    """Return the poses T_odom_base of the log: of a trajectory as they are, of images by a replay."""
    import numpy as np

    from calib import se3
    from calib.rig_file import read_rig
    from omnid.formats.tum import Trajectory, read_tum

    no_map = np.zeros((0, 3), np.float32)
    T_rig_base = se3.inverse(read_rig(args.rig).T_base_rig) if args.rig else np.eye(4)
    if args.log.suffix in (".txt", ".tum"):
        read = read_tum(args.log)
        return _Drive(Trajectory(read.stamps_ns, read.T @ T_rig_base), None, no_map, float(read.T[0, 2, 3]), 0)
    from omnid.config_use import unused_settings
    from omnid.diagnostics.progress import Progress
    from omnid.runs.replay import ReplayOptions, run_log
    from omnid.tracking_state import TrackingState

    config = settings_of(args)
    warnings = unused_settings(config, "replay", args.overrides)
    result = run_log(args.log, config, ReplayOptions(rig=args.rig, collect=True, progress=Progress))
    for warning in (*warnings, *result.warnings):
        print(f"omnid: warning: {warning}", file=sys.stderr)
    if len(result.stamps_ns) < 2:
        raise OmnidError(f"{args.log}: expected the poses of a drive, found {len(result.stamps_ns)}")
    live = result.T_map_rig_live
    return _Drive(
        Trajectory(result.stamps_ns, result.T_odom_rig @ T_rig_base),
        Trajectory(result.stamps_ns, live @ T_rig_base) if len(live) == len(result.stamps_ns) else None,
        no_map if result.map is None else result.map.xyz,
        float(result.T_odom_rig[0, 2, 3]),
        sum(state is TrackingState.LOST for state in result.states),
    )


def _judge(args: argparse.Namespace, drive: _Drive) -> int:
    """Print the errors, write the page, and return the exit code."""
    from calib.rig_file import write_file
    from omnid.recordings.acceptance import accept, visits_at_times, visits_by_standing
    from omnid.report.acceptance_page import acceptance_html, acceptance_text

    path = drive.odometry
    if args.marks:
        visits = visits_at_times(path, _since_start(args.marks, int(path.stamps_ns[0])))
    else:
        visits = visits_by_standing(path, args.distance_m)
    paths = {"odometry": path}
    if drive.in_map is not None:
        paths["poses in the map, as they were known while driving"] = drive.in_map
    drives = {name: accept(one, visits, args.distance_m) for name, one in paths.items()}
    faults = drives["odometry"].faults(args.within_percent / 100)
    if drive.lost:
        faults.append(f"{drive.lost} of {len(path.T)} poses are lost: no lengths are known there")
    if args.json:
        print_json({"accepted": not faults, "faults": faults, "drives": {k: _plain(v) for k, v in drives.items()}})
    else:
        print("\n".join(acceptance_text(name, found) for name, found in drives.items()))
        print("\n".join(f"not accepted: {line}" for line in faults) or f"accepted: within {args.within_percent:g} %")
    if args.output:
        html = acceptance_html(str(args.log), drives, faults, path, drive.map_xyz, drive.rig_height_m)
        write_file(args.output, html.encode("utf-8", "replace"))
    return int(bool(faults))


def _plain(found: Acceptance) -> dict[str, object]:
    """Return the result for JSON."""
    return {
        "distance_m": found.distance_m,
        "length_error_ratio": found.length_error_ratio,
        "length_spread_ratio": found.length_spread_ratio,
        "repeatability_m": found.repeatability_m,
        "rounds": found.rounds,
        "visits": [
            {"mark": visit.mark, "time_s": visit.time_s, "x_m": float(visit.T[0, 3]), "y_m": float(visit.T[1, 3])}
            for visit in found.visits
        ],
    }


def _since_start(words: Sequence[str], start_ns: int) -> list[float]:
    """Return the times of --marks in s since the first pose; a single word that is no number is a file of them."""
    numbers = [_number(word) for word in words]
    if len(words) == 1 and numbers[0] is None:
        try:
            words = Path(words[0]).read_text("utf-8").split()
        except (OSError, ValueError) as error:
            reason = getattr(error, "strerror", None) or error
            raise OmnidError(f"--marks {words[0]}: cannot be read: {reason}") from error
        numbers = [_number(word) for word in words]
    times_s = list[float]()
    for word, number in zip(words, numbers, strict=True):
        if number is None:
            raise OmnidError(f"--marks: expected times in seconds, found {word!r}")
        times_s.append(number - start_ns * 1e-9 if number > UNIX_S else number)
    return times_s


def _number(word: str) -> float | None:
    import math

    try:
        value = float(word)
    except ValueError:
        return None
    return value if math.isfinite(value) else None


def _write_keys(path: Path, keys: TextIO | Iterable[str]) -> int:
    """Write the Unix time of each entered line at once; refuse to replace an existing file of times."""
    if path.is_file() and path.stat().st_size:
        raise OmnidError(f"--keys {path}: expected a new file, found one of marks already taken; give another name")
    print("press Enter each time the point of the robot is over a mark: A, B, A, ...; Ctrl-D ends", file=sys.stderr)
    count = 0
    try:
        with path.open("w", encoding="utf-8") as file:
            for _ in keys:
                file.write(f"{time.time():.3f}\n")
                file.flush()
                count += 1
                print(f"{'B' if count % 2 == 0 else 'A'} {count}", file=sys.stderr)
    except OSError as error:
        raise OmnidError(f"--keys {path}: cannot be written: {error.strerror or error}") from error
    except KeyboardInterrupt:
        pass
    print(f"{path}: {count} times; give them as --marks {path}")
    return 0
