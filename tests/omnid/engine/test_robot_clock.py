"""The computer's clock is set in all ways: stamps have one Unix time each, and a step is reported once."""

from __future__ import annotations

import pytest

from omnid.engine.robot_clock import RobotClock
from tests.set_clock import SetClock

S = 10**9
START_NS = 1_700_000_000 * S


@pytest.mark.parametrize(
    ("step_s", "words"),
    [(3600.0, "forwards by 3600.000 s"), (0.02, "forwards by 0.020 s"), (-3 * 3600.0, "back by 10800.000 s")],
)
def test_a_step_is_found_and_reported_once_and_stamps_from_before_it_keep_their_time(step_s: float, words: str) -> None:
    lines: list[str] = []
    computer = SetClock(START_NS)
    clock = computer.clock(lines.append)
    computer.advance(100.0)
    before_ns = computer.monotonic_ns
    assert clock.unix_ns(before_ns) == START_NS + before_ns
    sent_before_ns = computer.unix_ns
    computer.set_forwards(step_s)
    computer.advance(0.1)
    now_ns, change_ns = computer.monotonic_ns, round(step_s * 1e9)
    assert [clock.unix_ns(now_ns) for _ in range(3)] == [START_NS + now_ns + change_ns] * 3
    assert clock.unix_ns(before_ns) == START_NS + before_ns, "the messages of one pair have one time"
    # A message that was on its way during the step is as old as it is, and so is one that is sent after it.
    assert clock.age_ns(sent_before_ns) == pytest.approx(0.1e9) and clock.age_ns(computer.unix_ns) == 0
    # A sender whose clock is another one is off by the step; sent once more it is still older.
    other_ns = computer.unix_ns - change_ns
    assert clock.age_ns(other_ns) == change_ns
    assert len(lines) == 1 and words in lines[0] and clock.stats()["steps"] == 1


@pytest.mark.parametrize("rate", [-500e-6, 40e-6])
def test_slewing_is_followed_in_silence(rate: float) -> None:
    lines: list[str] = []
    computer = SetClock(START_NS)
    clock, unix_ns = computer.clock(lines.append), 0
    for _ in range(4000):
        computer.advance(0.1)
        computer.set_forwards(0.1 * rate)
        before_ns, unix_ns = unix_ns, clock.unix_ns(computer.monotonic_ns)
        assert abs(unix_ns - computer.unix_ns) < 1_100_000 and unix_ns > before_ns
    assert not lines and clock.steps == 0


def test_a_thread_that_is_not_scheduled_between_two_readings_has_seen_no_step() -> None:
    lines: list[str] = []
    computer, pauses_s = SetClock(START_NS), [0.0]

    def late_ns() -> int:
        computer.advance(pauses_s[0])
        return computer.monotonic_ns

    clock = RobotClock(late_ns, lambda: computer.unix_ns, lines.append)
    pauses_s[0] = 0.05
    for _ in range(50):
        clock.follow()
    assert not lines and clock.unix_ns(5 * S) == START_NS + 5 * S
