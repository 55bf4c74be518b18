"""The motion monitor against a plain second account of its definition, on random commands, images and reports."""

from __future__ import annotations

import math
import random
from dataclasses import dataclass, field, replace

import pytest

from omnid.core.control.heading_controller import Twist
from omnid.core.control.motion_monitor import (
    NOT_COMMANDED,
    NOT_FOLLOWED,
    NOT_SEEN,
    Motion,
    MotionMonitor,
    MotionSettings,
)

NS = 10**9
Pair = tuple[float, float]
RECOVERY_HZ = 0.5  # shares of the motion that stops the base, forgotten in a second without anything unexplained
LONGEST_S = 0.2  # nothing is known of longer gaps


@dataclass
class Account:
    """Keeps everything, and compares by the words of the monitor's description; times in s."""

    settings: MotionSettings
    commands: list[tuple[float, Pair]] = field(default_factory=list)
    reports: list[tuple[float, Pair]] = field(default_factory=list)
    sums: dict[tuple[str, int], float] = field(default_factory=dict)
    reason: str = ""
    seen_s: float = 0.0
    reported_s: float = 0.0
    have_reported: bool = False

    def command(self, at_s: float, motion: Pair) -> None:
        self.commands.append((at_s, motion))
        if not any(any(pair) for then_s, pair in self.commands if at_s - then_s <= 2.0 + 1e-9):
            self.sums, self.reason = {}, ""

    def see(self, at_s: float, motion: Pair, sigmas: Pair) -> None:
        before_s, self.seen_s = self.seen_s, max(at_s, self.seen_s)
        if at_s <= before_s or not self.drives(at_s):
            return
        explained = self.within(self.commands, at_s) + self.within(self.reports, at_s)
        for axis in (0, 1):
            low, high, beyond = self.beyond(axis, explained, motion, sigmas)
            if not math.isnan(motion[axis]):
                short = beyond * (low + high) < 0.0
                self.add(NOT_SEEN, axis, abs(beyond) if short else 0.0, at_s - before_s)
                self.add(NOT_COMMANDED, axis, 0.0 if short else abs(beyond), at_s - before_s)

    def report(self, at_s: float, motion: Pair, sigmas: Pair) -> None:
        before_s, self.reported_s = self.reported_s, at_s
        counted = (motion[0], 0.0 if math.isnan(motion[1]) else motion[1])
        self.have_reported |= any(counted)
        if not self.have_reported or math.isnan(motion[0]):
            return
        self.reports.append((at_s, counted))
        for axis in (0, 1):
            if self.drives(at_s) and not math.isnan(motion[axis]):
                beyond = self.beyond(axis, self.within(self.commands, at_s), motion, sigmas)[2]
                self.add(NOT_FOLLOWED, axis, abs(beyond), at_s - before_s)

    def drives(self, at_s: float) -> bool:
        return any(any(pair) for pair in self.within(self.commands, at_s))

    def within(self, accounts: list[tuple[float, Pair]], at_s: float) -> list[Pair]:
        return [pair for then_s, pair in accounts if -1e-9 <= at_s - then_s <= self.settings.delay_s + 1e-9]

    def beyond(self, axis: int, explained: list[Pair], motion: Pair, sigmas: Pair) -> tuple[float, float, float]:
        """Return the lowest and the highest plausible value, and by how far the found one lies beyond them."""
        tolerance = (self.settings.speed_mps, self.settings.yaw_rate_radps)[axis] + 3.0 * sigmas[axis]
        lowest, highest = min(pair[axis] for pair in explained), max(pair[axis] for pair in explained)
        low = lowest * (1 - self.settings.slip if lowest > 0 else 1 + self.settings.slip) - tolerance
        high = highest * (1 + self.settings.slip if highest > 0 else 1 - self.settings.slip) + tolerance
        return low, high, motion[axis] - min(max(motion[axis], low), high)

    def add(self, reason: str, axis: int, speed: float, passed_s: float) -> None:
        limit = (self.settings.stop_m, self.settings.stop_rad)[axis]
        change = speed if speed > 0.0 else -RECOVERY_HZ * limit
        total = max(0.0, self.sums.get((reason, axis), 0.0) + change * min(passed_s, LONGEST_S))
        self.sums[reason, axis] = total
        if total > limit and not self.reason:
            self.reason = reason

    @property
    def doubtful(self) -> bool:
        limits = (self.settings.slow_m, self.settings.slow_rad)
        return any(total > limits[axis] for (_, axis), total in self.sums.items())


def wrong(rng: random.Random, motion: Pair) -> Pair:
    """Return another motion: a part of it, too much of it, its opposite, or nothing that is known."""
    return tuple(
        rng.choice((value, value, rng.uniform(-0.5, 2.5) * value, value + rng.gauss(0.0, 0.4), math.nan))
        for value in motion
    )  # type: ignore[return-value]


@pytest.mark.parametrize("seed", range(4))
def test_the_monitor_is_its_description(seed: int) -> None:
    rng, slowed, reasons = random.Random(seed), 0, set()
    for _ in range(12):
        settings = replace(
            MotionSettings(),
            delay_s=rng.uniform(0.1, 0.6),
            slip=rng.uniform(0.1, 0.7),
            stop_m=rng.uniform(0.1, 0.3),
            stop_rad=rng.uniform(0.3, 0.9),
        )
        monitor, account = MotionMonitor(settings), Account(settings)
        motion = asked = seen = reported = (0.0, 0.0)
        sigmas = (0.0, 0.0)
        for tick in range(300):
            now_ns = 100 * NS + tick * NS // 20
            if tick % 40 == 0:  # another wish, other errors of the cameras and of the wheels
                asked = rng.choice(((0.0, 0.0), (rng.uniform(-0.5, 0.5), rng.choice((0.0, rng.uniform(-1.0, 1.0))))))
                sigmas = rng.choice(((0.0, 0.0), (rng.uniform(0.0, 0.05), rng.uniform(0.0, 0.2))))
            if tick % 25 == 0:
                seen, reported = wrong(rng, asked), rng.choice((asked, wrong(rng, asked)))
            motion = asked if tick % 40 else motion
            monitor.add_command(now_ns, Twist(*motion))
            account.command(now_ns / NS, motion)
            if rng.random() < 0.7:
                monitor.add_report(now_ns, Motion(*reported, *sigmas))
                account.report(now_ns / NS, reported, sigmas)
            if rng.random() < 0.4:
                at_ns = now_ns - rng.choice((0, 1, 3)) * NS // 40  # some come out of their order
                monitor.add_seen(at_ns, Motion(*seen, *sigmas))
                account.see(at_ns / NS, seen, sigmas)
            assert monitor.reason == account.reason, (seed, tick)
            assert monitor.is_doubtful == account.doubtful, (seed, tick)
            slowed, reasons = slowed + monitor.is_doubtful, reasons | {monitor.reason}
    assert slowed > 300 and reasons >= {"", NOT_SEEN, NOT_FOLLOWED}
