"""The budget's steps are functions of the program, and its clock counts each moment once."""

from __future__ import annotations

import time

import pytest

from tests.benchmark.budget_steps import STEPS, Step, StepClock, owner_of


@pytest.mark.parametrize("step", STEPS, ids=lambda step: f"{step.module}.{step.name}")
def test_steps_are_functions_of_the_program(step: Step) -> None:
    owner, name = owner_of(step)
    assert callable(getattr(owner, name))


def test_inner_steps_are_not_counted_in_outer_ones() -> None:
    clock = StepClock()

    def compute(ms: float) -> None:
        end_ns = time.thread_time_ns() + ms * 1e6
        while time.thread_time_ns() < end_ns:
            pass

    inner = clock.timed("inner", compute)
    outer = clock.timed("outer", lambda: (compute(1), inner(20)))
    outer()
    outer()
    assert clock.calls == {("outer",): 2, ("outer", "inner"): 2}
    assert clock.own_ns["outer", "inner"] >= 40e6
    assert 2e6 <= clock.own_ns["outer",] < 40e6
