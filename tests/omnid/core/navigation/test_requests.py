"""Texts of requests: the words that are taken, and the refusal of all others."""

from __future__ import annotations

import numpy as np
import pytest

from omnid.core.navigation.requests import (
    GoalRequest,
    NavigationFrame,
    NavigationRequest,
    NavigationVerb,
    PathRequest,
    RouteAction,
    RouteRequest,
    is_halt,
    navigation_verb,
    route_request,
)
from omnid.errors import OmnidError


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("teach hall", RouteRequest(RouteAction.TEACH, "hall")),
        ("teach hall replace", RouteRequest(RouteAction.TEACH, "hall", replace=True)),
        ("stop", RouteRequest(RouteAction.STOP)),
        ("repeat hall", RouteRequest(RouteAction.REPEAT, "hall")),
        ("  repeat  hall-2 reverse  loops=12 ", RouteRequest(RouteAction.REPEAT, "hall-2", True, 12)),
        ("repeat hall from=start loops=2", RouteRequest(RouteAction.REPEAT, "hall", False, 2, True)),
    ],
)
def test_requests_about_routes(text: str, expected: RouteRequest) -> None:
    assert route_request(text) == expected


@pytest.mark.parametrize(
    "text",
    [
        "",
        "teach",
        "repeat a from=here from=start",
        "teach a replace replace",
        "teach ../etc",
        "repeat a loops=0",
        "repeat a loops=10001",
        "repeat a loops=1 loops=2",
        "repeat a backwards",
        "finish now",
        "TEACH a",
        "teach " + "a" * 65,
        "repeat a" + " " * 500,
        "repeat a\0",
    ],
)
def test_other_texts_are_refused_in_one_line(text: str) -> None:
    with pytest.raises(OmnidError) as error:
        route_request(text)
    assert "\n" not in str(error.value) and len(str(error.value)) < 300 and str(error.value).isascii()


@pytest.mark.parametrize("verb", list(NavigationVerb))
def test_verbs(verb: NavigationVerb) -> None:
    assert navigation_verb(f" {verb}\n") is verb
    with pytest.raises(OmnidError):
        navigation_verb(verb.upper())


@pytest.mark.parametrize(
    ("request_", "halts"),
    [
        (NavigationVerb.CANCEL, True),
        (NavigationVerb.PAUSE, True),
        (NavigationVerb.RESUME, False),
        (GoalRequest(NavigationFrame.ODOM, 1.0, 0.0), False),
        (PathRequest(NavigationFrame.ODOM, np.zeros((2, 2))), False),
        *((RouteRequest(action, "hall"), action is RouteAction.STOP) for action in RouteAction),
    ],
)
def test_only_cancel_pause_and_the_stop_of_a_route_halt(request_: NavigationRequest, halts: bool) -> None:
    assert is_halt(request_) == halts
