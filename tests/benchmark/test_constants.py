"""Constants say why they have their values: the number of those that do not may only fall."""

from __future__ import annotations

from tests.benchmark.constants import constants, constants_of, missing, page

# Lower it with each reason that is written; at 0 the test becomes one of equality.
MOST_WITHOUT_A_REASON = 340

SOURCE = '''"""Text."""
NAMED = "text with 3"

# Measured on a bench.
FIRST_PX = 3
SECOND_PX = 2.5  # of a window
# A third one.
THIRD_PX = 1
FOURTH_PX = 1

ALONE_M, OTHER_RAD = 0.1, 2 * 3.0  # of the base
STEP_RAD = 0.3  # the paper's step, Dang et al. 2012, section IV.F
PLAIN = 7
DERIVED = FIRST_PX * FIRST_PX


class Settings:
    window_px: int = knob(11, "side of the window, px")
'''


def test_reads_names_values_units_and_comments() -> None:
    found = {one.name: one for one in constants_of(SOURCE, "a.py")}
    assert list(found) == ["FIRST_PX", "SECOND_PX", "THIRD_PX", "FOURTH_PX", "ALONE_M", "OTHER_RAD", "STEP_RAD",
                           "PLAIN", "window_px"]
    assert (found["SECOND_PX"].value, found["SECOND_PX"].unit) == ("2.5", "px")
    assert found["SECOND_PX"].comment == "Measured on a bench. of a window"
    assert found["THIRD_PX"].comment == "Measured on a bench. A third one."
    assert found["FOURTH_PX"].comment == "Measured on a bench."
    assert (found["OTHER_RAD"].value, found["ALONE_M"].comment) == ("2 * 3.0", "of the base")
    assert found["STEP_RAD"].source == "Dang et al. 2012, section IV.F" or "paper" in found["STEP_RAD"].source
    assert found["window_px"].is_knob and found["window_px"].comment == "side of the window, px"


def test_tells_a_reason_from_a_description() -> None:
    found = constants_of(SOURCE, "a.py")
    assert [one.name for one in missing(found)] == ["ALONE_M", "OTHER_RAD", "PLAIN"]
    assert "| `PLAIN` | `7` |" in page(found)


def test_constants_without_a_reason_do_not_become_more() -> None:
    without = missing(constants())
    assert len(without) <= MOST_WITHOUT_A_REASON, f"give a reason for a new constant: {[one.name for one in without]}"
