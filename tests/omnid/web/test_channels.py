"""Messages for browsers: the newest of each kind, and the points of the path that are new."""

from __future__ import annotations

import json
import math

import pytest

from omnid.web.channels import MOST_POINTS, LivePath, Newest, compact, with_header


def follow(path: LivePath, shown: list[list[float]], seen: int) -> int:
    """Apply the next message as the page does; return the version that is seen then."""
    message = json.loads(path.message(seen))
    assert message["from"] <= len(shown)
    shown[message["from"] :] = message["points"]
    return path.version


def test_a_message_is_encoded_once_and_as_it_is_when_it_is_sent() -> None:
    values = iter(range(10))
    channel = Newest("state", lambda: str(next(values)))
    channel.changed()
    channel.changed()
    assert [channel.message(0), channel.message(1)] == ["0", "0"]
    channel.changed()
    assert channel.message(0) == "1"


def test_browsers_that_come_at_any_time_show_the_same_path() -> None:
    path = LivePath()
    shown: dict[int, list[list[float]]] = {1: [], 7: [], 100: []}
    seen = dict.fromkeys(shown, 0)
    for step in range(20_000):
        path.add(0.01 * step, math.sin(0.01 * step), gap=step in (500, 15_000))
        if step == 9000:
            path.clear()
        for every in shown:
            if step % every == 0:
                seen[every] = follow(path, shown[every], seen[every])
    for every, points in shown.items():
        follow(path, points, seen[every])
    assert shown[1] == shown[7] == shown[100] and 1000 < len(shown[1]) <= MOST_POINTS
    assert sum(len(point) > 2 for point in shown[1]) == 1 and shown[1][0][0] == pytest.approx(90.01, abs=0.1)


def test_a_path_of_nothing_but_gaps_and_of_wrong_numbers_stays_small() -> None:
    path = LivePath()
    for step in range(3 * MOST_POINTS):
        path.add(float(step % 1000), 0.0, gap=True)
        path.add(math.nan, 0.0)
        path.add(1e300, -math.inf)
    message = json.loads(path.message(0))
    assert 0 < len(message["points"]) <= MOST_POINTS


def test_a_stand_and_a_jump() -> None:
    path = LivePath()
    assert [path.add(0.0, 0.0), path.add(0.001, 0.0), path.add(0.03, 0.0), path.add(9.0, 0.0)] == [1, 0, 1, 1]
    assert json.loads(path.message(0))["points"] == [[0.0, 0.0], [0.03, 0.0], [9.0, 0.0, 1]]


def test_json_has_no_number_that_is_not_finite() -> None:
    with pytest.raises(ValueError, match="not JSON compliant"):
        compact({"x": math.nan})
    assert with_header({"type": "map"}, b"\0") == b'\0\0\0\x0e{"type":"map"}\0'
