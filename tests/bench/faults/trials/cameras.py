"""Faults of the cameras, injected into the frames of a LogCamera."""

from __future__ import annotations

from functools import partial
from typing import Final

from omnid.core.control.motion_monitor import NOT_COMMANDED, NOT_SEEN
from omnid.core.control.safety_rules import POSE_LOST, POSE_STALE
from omnid.transport.status_names import STOPPED_PREFIX
from tests.bench.faults.trials.trial import FAULTY_DAEMON, Outcome, Setting, driving, expect_motion, expect_stop, trial
from tests.replay.live import patient
from tests.waiting import wait_until


def camera_fault(setting: Setting, line: str, part: str, word: str) -> Outcome:
    """Inject a fault into the images for a while."""
    with driving(setting, module=FAULTY_DAEMON) as (daemon, operator, base):
        daemon.write_line(line)
        wait_until(lambda: word in operator.message(part), f"'{word}'")
        expect_stop(base)
        status = f"{part}: {operator.message(part)}; odometry: {operator.message('odometry')}"
        daemon.write_line("both ok")
        expect_motion(base)
    return Outcome("alive, recovered by itself", "stopped, turned again with the next setpoint", status)


# Fault -> what is injected, the part of the status that names it, and the words in which it does.
NO_IMAGES, FROZEN = "no images of the", "are frozen"
CAMERA_FAULTS: Final = {
    "upper camera stuck": ("upper mute", "pairing", f"{NO_IMAGES} upper camera"),
    "lower camera stuck": ("lower mute", "pairing", f"{NO_IMAGES} lower camera"),
    "both cameras stuck": ("both mute", "pairing", f"{NO_IMAGES} lower and the upper camera"),
    "garbage JPEG": ("lower garbage", "pairing", "cannot be decoded"),
    "JPEG cut in half": ("both cut", "pairing", "cannot be decoded"),
    "black frames": ("both black", "odometry", "lost"),
    "upper camera frozen": ("upper frozen", "pairing", f"images of the upper camera {FROZEN}"),
    "both cameras frozen": ("both frozen", "pairing", f"images of the lower and the upper camera {FROZEN}"),
}
for name, (line, part, word) in CAMERA_FAULTS.items():
    trial(name)(partial(camera_fault, line=line, part=part, word=word))


@trial("every fourth image repeated")
def repeated_now_and_then(setting: Setting) -> Outcome:
    """A driver that hands out a buffer twice is counted, and the robot drives on."""
    busy = ("--set", "controller.deadlines.pose_s=2.0")  # poses are late on a machine with other jobs
    with driving(setting, *busy, module=FAULTY_DAEMON) as (daemon, operator, _):
        daemon.write_line("upper glitch")
        wait_until(lambda: int(operator.values("pairing").get("repeated_upper", "0")) >= 8, "eight repeated images")
        stops = {f"{STOPPED_PREFIX}{reason}" for reason in (POSE_STALE, POSE_LOST)}
        assert not stops & operator.values("wheels").keys(), operator.values("wheels")
        status = f"pairing: {operator.message('pairing')}, repeated_upper counted"
    return Outcome("alive", "drove on as commanded", status)


@trial("images of another drive")
def another_drive(setting: Setting) -> Outcome:
    """The images go to and fro at 0.5 m/s, as if the lens saw a screen, while 0.3 m/s forwards are commanded."""
    words = patient("controller.motion.check=true")
    with driving(setting, *words, module=FAULTY_DAEMON) as (_, operator, base):
        counts = [f"{STOPPED_PREFIX}{reason}" for reason in (NOT_SEEN, NOT_COMMANDED)]
        wait_until(lambda: any(key in operator.values("wheels") for key in counts), "a stop for this reason")
        wait_until(lambda: not base.drives, "wheels that stop although commands arrive")
        operator.stop_sending()  # after two seconds at rest the base would try again
        expect_stop(base)
        status = f"wheels: {operator.message('wheels')}"
    return Outcome("alive", "slowed down, then stopped", status)
