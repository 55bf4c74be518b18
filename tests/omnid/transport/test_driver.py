"""Commands and requests of programs: where there is no answer, the error says what to check."""

from __future__ import annotations

import contextlib

import pytest

from omnid.client import Robot
from omnid.errors import OmnidError
from omnid.transport.bus import Bus, BusConfig
from tests.omnid.transport.bus_fixtures import free_endpoint, robot


def test_a_request_without_an_answer_is_an_error() -> None:
    with robot() as (_, program, received):
        with pytest.raises(OmnidError, match="omnid has not answered"):
            program.driver().arm(timeout_s=0.3)
        assert [request.topic for request in received] == ["cmd/arm"]
    endpoint = free_endpoint()
    with (
        contextlib.closing(Bus(BusConfig(listen=(endpoint,)))),
        Robot(connect=(endpoint,)) as program,
        pytest.raises(OmnidError, match=r"no robot 'omnid' takes such requests there \(robots there: omnid\)"),
    ):
        program.driver().arm()
