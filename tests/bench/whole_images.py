"""Images that are whole, but not of one instant or geometry: `python -m tests.bench.whole_images RIG LOG TRUTH`.

Each kind edits the images of some pairs of a log, which is then replayed: how many poses are `tracking`, and how many
of these are wrong by more than 3 sigma and 5 mm. Kinds named "other" were not looked at while the test for broken
images was developed. The frame of the truth is turned into that of the rig by the poses of the unedited images.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final, NamedTuple

import cv2
import numpy as np

from calib import se3
from calib.rig_file import read_rig
from omnid.api import replay
from omnid.core.odometry.pose_estimation import rigid_fit
from omnid.formats.tum import read_tum
from tests.bench.results import ResultTable, columns, run
from tests.drivers.logs.mcap_logs import LOWER, UPPER
from tests.replay.edited import images, save
from tests.simulation.photographs import Image, repeat_lines, roll, shift, tear, turn, warp

SIGMAS: Final = 3.0
LEAST_M: Final = 0.005  # of an error beside which a pose may be called sure
Edit = Callable[[Sequence[Image]], list[Image]]


class Kind(NamedTuple):
    """Cameras whose images are edited, l: lower, u: upper, and how."""

    cameras: str
    edit: Edit


def _torn(share: float, axis: int = 0, **how: object) -> Edit:
    return lambda taken: tear(taken, round(share * taken[0].shape[axis]), axis=axis, **how)  # type: ignore[arg-type]


def _wandering(taken: Sequence[Image]) -> list[Image]:
    height, draw = len(taken[0]), np.random.default_rng(5).uniform(0.2, 0.8, len(taken))
    return tear(taken, lambda number: int(draw[number] * height), since=1)


def _lines(share: float, count: int, **how: object) -> Edit:
    return lambda taken: repeat_lines(taken, round(share * len(taken[0])), count, **how)  # type: ignore[arg-type]


KINDS: Final[dict[str, Kind]] = {
    "whole": Kind("", list),
    "torn, lower": Kind("l", _torn(0.5)),
    "torn, upper": Kind("u", _torn(0.4)),
    "torn, both": Kind("lu", _torn(0.5)),
    "torn at a column, both": Kind("lu", _torn(0.5, 1)),
    "torn at a changing row, lower": Kind("l", _wandering),
    "torn at a changing row, both": Kind("lu", _wandering),
    "torn each third, both": Kind("lu", _torn(0.45, every=3)),
    "torn from 8 on, upper": Kind("u", _torn(0.6, since=8)),
    "torn from 8 on, both, old above": Kind("lu", _torn(0.35, since=8, new_below=True)),
    "cropped from 10 on, both": Kind("lu", lambda taken: shift(taken, (6, 0), since=10)),
    "cropped from 10 on, lower": Kind("l", lambda taken: shift(taken, (0, -5), since=10)),
    "rows missing from 10 on, both": Kind("lu", _lines(0.5, -6, since=10)),
    "rows twice, each third, upper": Kind("u", _lines(0.4, 5, every=3, since=2)),
    "mirror turned from 10 on, lower": Kind("l", lambda taken: turn(taken, 1.0, since=10)),
    "rolling, both": Kind("lu", lambda taken: roll(taken, 0.5)),
    "rolling, upper": Kind("u", lambda taken: roll(taken, 0.5)),
    "other: torn, upper, old above": Kind("u", _torn(0.55, new_below=True)),
    "other: torn at a column, both": Kind("lu", _torn(0.35, 1, new_below=True)),
    "other: torn each second from 5 on, both": Kind("lu", _torn(0.62, every=2, since=5)),
    "other: torn from 14 on, lower": Kind("l", _torn(0.42, since=14)),
    "other: cropped from 6 on, upper": Kind("u", lambda taken: shift(taken, (-4, 4), since=6)),
    "other: zoomed from 12 on, both": Kind(
        "lu", lambda taken: warp(taken, np.array([[1.02, 0, -7.0], [0, 1.02, -7.0]]), since=12)
    ),
    "other: cropped now and then, both": Kind(
        "lu", lambda taken: [each if n % 7 < 4 else shift([each], (3, -3), since=0)[0] for n, each in enumerate(taken)]
    ),
    "other: rows missing, lower": Kind("l", _lines(0.6, -5, since=0)),
    "other: rows twice from 9 on, both": Kind("lu", _lines(0.4, 8, since=9)),
    "other: mirror turned from 7 on, upper": Kind("u", lambda taken: turn(taken, -0.7, since=7)),
    "other: rolling the other way, both": Kind("lu", lambda taken: roll(taken, -0.6)),
    "other: rolling over columns, lower": Kind("l", lambda taken: roll(taken, 0.4, axis=1)),
}


def _decoded(jpeg: bytes) -> Image:
    return np.asarray(cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_GRAYSCALE), np.uint8)


def whole_images(
    rig: Path, log: Path, truth: Path, kinds: Sequence[str] = (), *, pairs: int = 33, since: int = 0
) -> None:
    """Print a row for each kind that begins with one of the given words, or for all."""
    head = columns("log", "kind", "pairs", "tracking", "wrong", "most off|mm", "its sigma|mm", "lines")
    table = ResultTable("whole_images", "Images that are whole, but not right", head)
    read = read_rig(rig)
    every = images(log, *(topic or None for topic in read.topics))
    read = replace(read, topics=(LOWER, UPPER))
    taken = [each for each in every if since <= each.pair <= since + pairs]
    poses, R = read_tum(truth), None
    for name, kind in KINDS.items():
        if name != "whole" and kinds and not name.startswith(tuple(kinds)):
            continue
        # 1. Edit the images of the kind's cameras. The first pair has no image before it.
        edited = list(taken)
        for camera in ("lower", "upper"):
            own = [number for number, image in enumerate(taken) if image.camera == camera]
            if camera[0] in kind.cameras:
                pixels = [_decoded(taken[n].jpeg) for n in own]
                for number, image in zip(own, kind.edit(pixels), strict=True):
                    jpeg = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 95])[1].tobytes()
                    edited[number] = replace(taken[number], jpeg=jpeg)
        edited = [image for image in edited if image.pair != since]
        # 2. Replay them, and compare with the truth.
        with tempfile.TemporaryDirectory() as folder:
            result = replay(save(Path(folder) / "log.mcap", edited), read, overrides=["places.enabled=false"])
        T_true = poses.T[[int(np.abs(poses.stamps_ns - stamp).argmin()) for stamp in result.stamps_ns]]
        true_m, found_m = (se3.inverse(T_true[0]) @ T_true)[:, :3, 3], result.T_odom_rig[:, :3, 3]
        R = rigid_fit(true_m, found_m)[:3, :3] if R is None else R
        error_m = np.linalg.norm(found_m - true_m @ R.T, axis=1)
        sigma_m = np.sqrt(np.array([np.linalg.eigvalsh(each[:3, :3])[-1] for each in result.covariances]))
        sure = np.array([state == "tracking" for state in result.states])
        wrong = sure & (error_m > np.maximum(LEAST_M, SIGMAS * sigma_m))
        worst = int(np.where(wrong, error_m, -1.0).argmax()) if wrong.any() else int(error_m.argmax())
        reported = [line.split(";")[0] for line in result.warnings if line.startswith("images of the ")]
        of_worst = round(1e3 * error_m[worst], 1), round(1e3 * sigma_m[worst], 1)
        cells = log.parent.name, name, len(sure), int(sure.sum()), int(wrong.sum()), *of_worst
        table.add(*cells, " / ".join(reported))


if __name__ == "__main__":
    run(whole_images)
