"""Elements of figures: axes with round ticks, lines that are interrupted in gaps, escaped text."""

from __future__ import annotations

import pytest

from omnid.report.svg import Axis, axis_for, coord, label, path_d, pieces, polyline, rectangles, round_step, text


def test_values_outside_an_axis_are_at_its_nearer_end() -> None:
    axis = Axis(0.0, 10.0, 100.0, 200.0)
    assert [axis.px(value) for value in (-5.0, 0.0, 2.5, 10.0, 99.0)] == [100.0, 100.0, 125.0, 200.0, 200.0]
    assert Axis(1.0, 100.0, 0.0, 2.0, log=True).px(10.0) == pytest.approx(1.0)


def test_ticks_are_round_and_not_more_than_asked_for() -> None:
    assert Axis(0.0, 1.0, 0.0, 1.0).ticks(5) == pytest.approx([0.0, 0.2, 0.4, 0.6, 0.8, 1.0])
    assert Axis(-3.0, 4.0, 0.0, 1.0).ticks(4) == [-2.0, 0.0, 2.0, 4.0]
    assert Axis(0.01, 100.0, 0.0, 1.0, log=True).ticks(5) == pytest.approx([0.01, 0.1, 1.0, 10.0, 100.0])


@pytest.mark.parametrize(("least", "step"), [(1.0, 1.0), (1.1, 2.0), (0.021, 0.05), (700.0, 1000.0)])
def test_a_round_step_is_not_less(least: float, step: float) -> None:
    assert round_step(least) == pytest.approx(step)


def test_an_axis_holds_all_values_and_zero_where_it_belongs_to_them() -> None:
    plain, zero = (
        axis_for([2.0, 4.0], (0, 1), log=False, zero=False),
        axis_for([2.0, 4.0], (0, 1), log=False, zero=True),
    )
    assert plain.low < 2.0 < 4.0 < plain.high and zero.low == 0 and zero.high > 4.0
    below = axis_for([-4.0, -2.0], (0, 1), log=False, zero=True)
    assert below.low < -4.0 and below.high == 0
    same = axis_for([3.0], (0, 1), log=False, zero=False)
    assert same.low < 3.0 < same.high
    decades = axis_for([0.02, 30.0], (0, 1), log=True, zero=False)
    assert (decades.low, decades.high) == pytest.approx((0.01, 100.0))


def test_a_line_is_interrupted_where_points_are_missing() -> None:
    points = [(float(second), 0.0) for second in (0, 1, 2, 3, 20, 21)]
    assert [len(piece) for piece in pieces(points)] == [4, 2] and list(pieces([])) == []


def test_elements_are_short_and_escaped() -> None:
    assert path_d([(1.0, 2.04), (3.26, 4.0)]) == "M1 2L3.3 4" and coord(-0.25) == "-0.2"
    assert polyline([], "s") == "" and polyline([(5.0, 6.0)], "s") == "<path s d='M3.7 6h2.6'/>"
    assert text((1.0, 2.0), "a<b") == "<text x='1' y='2' >a&lt;b</text>"
    assert rectangles([(1.0, 1.0)], (2.0, 5.0)) == "M1 2H1.6v3H1z", "a span without length is seen, too"
    assert [label(value) for value in (0.1, -0.0, 123456789.0)] == ["0.1", "0", "1e+08"]
