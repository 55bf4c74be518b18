"""Images that are whole, but torn, displaced, or with lines twice or missing: no pose of them is sure, a line says so.

The boundary is `omnid replay` of an edited log; the error is that of the position against the rendered truth.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final, Literal, NamedTuple

import cv2
import numpy as np
import pytest

from calib import se3
from omnid.api import replay
from omnid.formats.tum import read_tum
from tests.replay.edited import images, save
from tests.simulation.photographs import Image, repeat_lines, roll, shift, tear, turn

Edit = Callable[[Sequence[Image]], list[Image]]
SINCE: Final = 8
SIGMAS: Final = 3.0
LEAST_M: Final = 0.005  # of an error beside which a pose may be called sure


class Case(NamedTuple):
    """Images of which cameras are edited, a pattern of the line that says it, and the pair from which on they are."""

    cameras: tuple[Literal["lower", "upper"], ...]
    edit: Edit
    line: str
    since: int = SINCE


BOTH: Final = ("lower", "upper")
CASES: Final = {
    "torn, one camera": Case(
        ("lower",), lambda taken: tear(taken, 128, since=SINCE), "the lower camera are torn at row"
    ),
    "torn, both": Case(BOTH, lambda taken: tear(taken, 100, since=SINCE), "the upper cameras are torn at row"),
    "torn, both, all": Case(BOTH, lambda taken: tear(taken, 120), "the upper cameras are torn at row", since=1),
    "torn, each third": Case(
        ("upper",), lambda taken: tear(taken, 128, every=3, since=SINCE), "upper camera are torn at row"
    ),
    "displaced, both": Case(
        BOTH, lambda taken: shift(taken, (3, 0), since=SINCE), r"cameras were displaced by \+(2\.9|3\.)"
    ),
    "displaced, one camera": Case(
        ("upper",), lambda taken: shift(taken, (0, -4), since=SINCE), r"camera were displaced by \S+, -(3\.[89]|4\.)"
    ),
    "lines missing": Case(
        BOTH, lambda taken: repeat_lines(taken, 128, -4, since=SINCE), "displaced by .* px below row 1[123]"
    ),
    "a mirror has moved": Case(
        ("lower",),
        lambda taken: turn(taken, 1.0, since=SINCE),
        r"the lower camera were displaced by .* turned by -(0\.9|1\.0)",
    ),
    # The first image is not rolled, and left out.
    "lines of both read one after another": Case(
        BOTH, lambda taken: roll(taken, 1.0), r"cameras have rows that .* line time about -[345]\d\d us .* set", since=0
    ),
}


def _decoded(jpeg: bytes) -> Image:
    return np.asarray(cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_GRAYSCALE), np.uint8)


def edited(log: Path, case: Case) -> Path:
    """Write a log with the images of a case beside another one; all of its images are edited where since is 0."""
    taken = images(log)
    for camera in case.cameras:
        own = [number for number, image in enumerate(taken) if image.camera == camera]
        pixels = [_decoded(taken[n].jpeg) for n in own]
        for number, image in zip(own, case.edit(pixels), strict=True):
            jpeg = cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 95])[1].tobytes()
            taken[number] = replace(taken[number], jpeg=jpeg)
    return save(log.with_name("edited.mcap"), (image for image in taken if case.since or image.pair))


@pytest.mark.parametrize("name", CASES)
def test_a_broken_image_is_named_and_no_pose_of_it_is_sure(course: Path, tmp_path: Path, name: str) -> None:
    case = CASES[name]
    result = replay(edited(course / "log.mcap", case), course / "rig.toml", overrides=["places.enabled=false"])
    told = [line for line in result.warnings if line.startswith("images of the ")]
    assert any(re.search(case.line, line) for line in told), result.warnings
    assert len(told) <= 4
    truth = read_tum(course / "truth.txt")
    T_true = truth.T[len(truth.T) - len(result.T_odom_rig) :]
    T_true = se3.inverse(T_true[0]) @ T_true
    error_m = np.linalg.norm(result.T_odom_rig[:, :3, 3] - T_true[:, :3, 3], axis=1)
    sigma_m = np.sqrt(np.array([np.linalg.eigvalsh(each[:3, :3])[-1] for each in result.covariances]))
    sure = np.array([state == "tracking" for state in result.states])
    assert not (sure & (error_m > np.maximum(LEAST_M, SIGMAS * sigma_m))).any(), (error_m, sigma_m, result.states)
    if case.since:
        assert sure[: case.since].all()


def test_whole_images_are_not_suspected(course: Path) -> None:
    result = replay(course / "log.mcap", course / "rig.toml", overrides=["places.enabled=false"])
    assert not [line for line in result.warnings if line.startswith("images of the ")]
    assert set(map(str, result.states)) == {"tracking"}
