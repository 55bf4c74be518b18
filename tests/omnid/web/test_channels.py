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


def test_versions_count_from_one_and_a_message_that_was_never_changed_is_empty() -> None:
    channel = Newest("state", lambda: "it")
    assert (channel.version, channel.message(0)) == (0, "")
    for version in (1, 2, 3):
        channel.changed()
        assert (channel.version, channel.message(0)) == (version, "it")


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize("value", [1e6, -1e6, 1e6 + 0.5, 2e6, -2e6, math.nan, math.inf, -math.inf])
def test_positions_that_cannot_be_drawn_are_no_points(axis: int, value: float) -> None:
    path = LivePath()

    def add(value: float) -> bool:
        return path.add(value, 0.0) if axis == 0 else path.add(0.0, value)

    assert add(value) is False and path.version == 0
    assert add(math.copysign(999_999.5, value)) is True and path.version == 1


def test_a_gap_is_a_jump_of_more_than_a_metre_or_ten_steps() -> None:
    path = LivePath()
    for x_m in (0.0, 0.9, 1.9, 3.0):
        path.add(x_m, 0.0)
    assert json.loads(path.message(0))["points"] == [[0.0, 0.0], [0.9, 0.0], [1.9, 0.0], [3.0, 0.0, 1]]
    path._path.step_m = 0.5
    for x_m in (7.5, 12.6):
        path.add(x_m, 0.0)
    assert json.loads(path.message(0))["points"][-2:] == [[7.5, 0.0], [12.6, 0.0, 1]]


def test_the_message_begins_after_what_was_seen_and_with_all_after_a_clear() -> None:
    path = LivePath()
    for x_m in (0.0, 0.5, 1.00049):
        path.add(x_m, -x_m)
    assert path.version == 3
    assert json.loads(path.message(2)) == {"type": "path", "from": 2, "points": [[1.0, -1.0]]}
    assert [json.loads(path.message(seen))["from"] for seen in (0, 1, 3)] == [0, 1, 3]
    path.clear()
    assert path.version == 4
    path.add(7.0, 0.0)
    assert path.version == 5
    assert [json.loads(path.message(seen))["from"] for seen in (0, 3, 4, 5)] == [0, 0, 0, 1]
    assert json.loads(path.message(3))["points"] == [[7.0, 0.0]]


def test_after_every_second_point_was_dropped_all_are_sent_again_once() -> None:
    path = LivePath()
    for step in range(MOST_POINTS):
        path.add(0.03 * step, 0.0)
    assert path.version == MOST_POINTS
    path.add(0.03 * MOST_POINTS, 0.0)
    count = len(json.loads(path.message(0))["points"])
    assert path.version == MOST_POINTS + 1 + count, "no version that a browser may have seen"
    assert json.loads(path.message(MOST_POINTS))["from"] == 0
    assert json.loads(path.message(path.version)) == {"type": "path", "from": count, "points": []}
