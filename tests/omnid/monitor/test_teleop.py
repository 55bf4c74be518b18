"""Keys as a stick."""

from __future__ import annotations

import math

import pytest

from omnid.core.control.heading_controller import VelocityLimits
from omnid.monitor.teleop import HOLD_S, Stick

LIMITS = VelocityLimits(velocity_mps=1.0, yaw_rate_radps=2.0)
UP, DOWN, RIGHT, LEFT = b"\x1b[A", b"\x1b[B", b"\x1b[C", b"\x1b[D"


@pytest.fixture
def stick() -> Stick:
    return Stick(LIMITS, share=0.5)


def test_a_motion_lasts_as_long_as_its_key_is_repeated(stick: Stick) -> None:
    assert stick.twist(0.0) == (0.0, 0.0) and not stick.commands(0.0)
    stick.press(UP, 10.0)
    assert stick.twist(10.0 + HOLD_S) == (0.5, 0.0)
    assert stick.twist(10.01 + HOLD_S) == (0.0, 0.0)
    assert stick.commands(10.0 + 2 * HOLD_S) and not stick.commands(10.01 + 2 * HOLD_S)


def test_the_share_stays_within_the_limits(stick: Stick) -> None:
    stick.press(b"+" * 50 + UP, 0.0)
    assert stick.twist(0.0) == (1.0, 0.0)
    stick.press(b"-" * 50, 0.0)
    assert 0.0 < stick.twist(0.0)[0] <= 0.1


@pytest.mark.parametrize("key", [b" ", b"x", b"\x1b", b"\xff", b"\n"])
def test_any_other_key_ends_the_motion(stick: Stick, key: bytes) -> None:
    stick.press(UP + key, 0.0)
    assert stick.twist(0.0) == (0.0, 0.0) and stick.commands(0.0)
    assert stick.stop_asked == (key == b" ")


@pytest.mark.parametrize(
    "parts", [(b"\x1b", b"[A"), (b"\x1b[", b"A"), (b"x\x1b", b"[A"), (b"\x1bOA",), (b"\x1bO", b"A")]
)
def test_an_arrow_that_comes_in_parts_or_in_the_other_mode_of_terminals_drives_and_does_not_arm(
    stick: Stick, parts: tuple[bytes, ...]
) -> None:
    for part in parts:
        stick.press(part, 0.0)
    assert stick.twist(0.0) == (0.5, 0.0)
    assert not (stick.arm_asked or stick.quit or stick.stop_asked)


@pytest.mark.parametrize("key", [b"\x1b[1;2A", b"\x1bOQ", b"\x1b[5~", b"\x1b[15~", b"\x1b[?1;2c"])
def test_other_keys_of_several_bytes_end_the_motion_and_mean_nothing_else(stick: Stick, key: bytes) -> None:
    stick.press(UP + key, 0.0)
    assert stick.twist(0.0) == (0.0, 0.0)
    assert not (stick.arm_asked or stick.quit or stick.stop_asked) and stick.share == 0.5


@pytest.mark.parametrize("begun", [b"\x1b", b"\x1b[", b"\x1bO", b"\x1b[1;", b"\x1b[" + b"1" * 100])
def test_a_stop_after_a_part_of_a_key_is_a_stop(stick: Stick, begun: bytes) -> None:
    stick.press(UP + begun, 0.0)
    assert stick.twist(0.0) == (0.0, 0.0), "the key Esc ends the motion"
    stick.press(b" ", 0.1)
    assert stick.stop_asked


def test_letters(stick: Stick) -> None:
    stick.press(b"aq", 0.0)
    assert stick.arm_asked and stick.quit and not stick.stop_asked


def test_keys_that_were_typed_while_it_connected_stop_and_arm_and_move_nothing(stick: Stick) -> None:
    stick.press(UP + b"a ", -math.inf)
    assert stick.arm_asked and stick.stop_asked
    assert stick.twist(0.0) == (0.0, 0.0) and not stick.commands(0.0)
